"""The table of what travels holds together."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.installed import topic_named
from cocoro.keys import matches
from cocoro.messages import Message
from cocoro.topics import REQUESTS, TOPICS


def test_no_name_is_taken_twice() -> None:
    names = [topic.name for topic in TOPICS] + [request.name for request in REQUESTS]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_a_row_is_complete(topic: topics.Topic[Message]) -> None:
    service, _, _ = topic.name.partition("/")
    assert topic.publisher in ("*", service) or (service, topic.publisher) in COMMANDED
    assert (topic.publisher == "*") == ("{service}" in topic.name)
    assert issubclass(topic.type, Message)
    assert topic.max_age_s > 0
    assert topic.rate_hz is None or topic.rate_hz > 0
    assert topic.doc.endswith(".")


COMMANDED = {("base", "planning"), ("arm", "planning"), ("hand", "planning")}
"""A command's key lies with whom it commands."""


def test_only_frames_travel_as_frames_and_commands_expire() -> None:
    assert [topic for topic in TOPICS if topic.qos is Qos.FRAME] == [topics.FRAME]
    commands = {topic.name for topic in TOPICS if topic.qos is Qos.COMMAND}
    assert commands == {"base/command", "arm/command", "hand/command", "executive/intent", "sim/clock"}


def test_a_state_that_is_published_at_a_rate_may_be_late_a_few_times() -> None:
    for topic in TOPICS:
        if topic.rate_hz is not None:
            assert topic.max_age_s >= 2 / topic.rate_hz, topic.name


def test_keys_carry_the_robots_name() -> None:
    assert topics.BASE_COMMAND.key("ada") == "ada/base/command"
    assert topics.RUN.key("ada") == "ada/executive/run"


def test_a_per_service_row_stands_for_one_topic_a_service() -> None:
    health = topics.HEALTH.of("base")
    assert (health.name, health.publisher, health.type) == ("base/health", "base", topics.HEALTH.type)
    assert topics.ESTOP.of("arm").key("ada") == "ada/arm/estop"
    assert matches(topics.HEALTH.of("*").key("ada"), health.key("ada"))
    assert not matches(topics.HEALTH.of("*").key("ada"), health.key("bob"))


def test_a_topic_is_found_by_its_name() -> None:
    assert topic_named("base/state") is topics.BASE_STATE
    assert topic_named("base/health") == topics.HEALTH.of("base")
    assert topic_named("base/nonsense") is None
    assert topic_named("") is None


@pytest.mark.parametrize("request_row", REQUESTS, ids=lambda row: row.name)
def test_a_requests_row_is_complete(request_row: topics.Request[Any, Any]) -> None:
    assert request_row.timeout_s > 0
    assert issubclass(request_row.request, msgspec.Struct)
    assert issubclass(request_row.reply, msgspec.Struct)
    assert request_row.doc.endswith(".")
