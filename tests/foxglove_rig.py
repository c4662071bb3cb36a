"""A server of Foxglove's protocol with a service, as tests of viewers need it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec

from apps.captures.export.foxglove_server import FoxgloveServer, Service
from cocoro import topics
from cocoro.objects import Catalogue
from cocoro.robot import Robot

ROBOT = Robot.load()
SPOKEN = [topic for topic in topics.TOPICS if "{" not in topic.name]


class Fetch(msgspec.Struct):
    label: str


def answered(given: dict[str, Any]) -> dict[str, Any]:
    if "label" not in given:
        raise ValueError("fetch: label is missing")
    return {"accepted": True, "label": given["label"]}


@contextmanager
def serving() -> Iterator[FoxgloveServer]:
    services = [Service("/task/fetch", Fetch, answered)]
    with FoxgloveServer(
        "ada", ROBOT, Catalogue.load(), SPOKEN, host="127.0.0.1", port=0, services=services
    ) as made:  # fmt: skip
        yield made
