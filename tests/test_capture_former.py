"""Captures of earlier versions are read as today's types, by the rules of `cocoro.capture.former`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from apps.captures.info import report
from cocoro.capture.former import todays_payload
from cocoro.capture.reader import Capture
from cocoro.messages import ClockTick, Exchange, Intent, TaskRequest
from services.executive.tasks import TASKS, GoToTask

FORMER = Path(__file__).parent / "golden" / "former.mcap"
"""Clock and intents of a fetch, 2 s, recorded by a version that had other shapes; it cannot be made anew."""


def test_a_renamed_type_is_read_as_todays() -> None:
    with Capture.open(FORMER) as capture:
        ticks = list(capture.messages("sim/clock"))
        schema = capture.schema(ticks[0].channel)
        assert schema is not None
        assert schema.name == "Clock"
        read = [capture.read(tick) for tick in ticks]
        assert all(isinstance(tick, ClockTick) for tick in read)
        (key,) = (key for key in report(capture).keys if key.key.endswith("sim/clock"))
    assert key.changed == ()


def test_a_former_intent_is_read_and_replayed_in_todays_shape() -> None:
    with Capture.open(FORMER) as capture:
        records = list(capture.messages("executive/intent"))
        raw = capture.decode(records[-1])
        assert isinstance(raw["behaviour"], str)
        intents = [capture.read(record) for record in records]
        names = list(dict.fromkeys(intent.action.name for intent in intents if isinstance(intent, Intent)))
        assert names[:3] == ["idle", "search", "approach"]
        last = intents[-1]
        assert isinstance(last, Intent)
        assert (last.action.name, last.action.target) == (raw["behaviour"], raw["label"])
        assert (last.task_id, last.step, last.seq) == (raw["task_id"], raw["step"], raw["seq"])
        played = todays_payload("Intent", records[-1].payload)
    assert msgspec.msgpack.decode(played, type=Intent) == last
    assert todays_payload("Intent", played) == played, "what is of today stays as it is"


def test_a_former_request_is_read_in_todays_shape() -> None:
    question = {"task": "go-to", "label": "red_can", "timeout_s": 9.0, "bring": False, "for_s": None,
                "distance_m": 0.4, "first": 0, "count": 1000}  # fmt: skip
    former = msgspec.msgpack.encode(Exchange(request="executive/run", question=question, answer={"accepted": True}))
    read = msgspec.msgpack.decode(todays_payload("Exchange", former), type=Exchange)
    request = msgspec.convert(read.question, TaskRequest)
    assert TASKS.read(request.task) == GoToTask(label="red_can", distance_m=0.4)
    assert request.timeout_s == 9.0
    assert read.answer == {"accepted": True}


def test_what_is_no_message_stays_as_it_is() -> None:
    for payload in (b"\xc1", msgspec.msgpack.encode([1]), msgspec.msgpack.encode({"behaviour": 7})):
        assert todays_payload("Intent", payload) == payload
        assert todays_payload("BaseState", payload) == payload
