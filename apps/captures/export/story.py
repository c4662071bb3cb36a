"""What a capture tells besides its pictures, small enough to be held in memory: looked up by frame and by time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from typing import Generic, TypeVar

import msgspec

from apps.captures.origin import recorded_file
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import NotReadableError
from cocoro.messages import Detections, Message, PlannerStatus, TaskState
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import DETECTIONS, PLAN, TASK, Topic

M = TypeVar("M", bound=Message)


class Track(Generic[M]):
    """One topic's messages by log time."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._messages: list[M] = []

    def add(self, log_ns: int, message: M) -> None:
        self._times_ns.append(log_ns)
        self._messages.append(message)

    def at(self, log_ns: int) -> M | None:
        """The newest at a time; None before the first."""
        place = bisect_right(self._times_ns, log_ns)
        return self._messages[place - 1] if place else None


class Story:
    """Reads a capture once, without its pictures."""

    def __init__(self, capture: Capture) -> None:
        self.tasks: Track[TaskState] = _track(capture, TASK)
        self.plans: Track[PlannerStatus] = _track(capture, PLAN)
        self._seen: dict[tuple[int, int], Detections] = {}
        for _, seen in read(capture, DETECTIONS):
            self._seen[seen.frame_incarnation, seen.frame_seq] = seen

    def seen_in(self, incarnation: int, seq: int) -> Detections | None:
        """What perception made of a frame."""
        return self._seen.get((incarnation, seq))


def read(capture: Capture, topic: Topic[M]) -> Iterator[tuple[Record, M]]:
    """A topic's messages that can be read as today's type."""
    for record in capture.messages(topic.key(capture.robot)):
        try:
            message = capture.read(record)
        except NotReadableError:
            continue
        if isinstance(message, topic.type):
            yield record, message


def robot_of(capture: Capture) -> Robot:
    """The robot that the capture describes; the Calliope, where it describes none."""
    told = capture.metadata.get("robot", {}).get("description")
    return Robot.load() if told is None else Robot.from_data(msgspec.json.decode(told), f"{capture.path}, robot")


def catalogue_of(capture: Capture) -> Catalogue:
    """The objects that perception knew then; today's, where the capture does not say."""
    return recorded_file(capture, "perception", "objects", Catalogue.load)


def _track(capture: Capture, topic: Topic[M]) -> Track[M]:
    track: Track[M] = Track()
    for record, message in read(capture, topic):
        track.add(record.log_ns, message)
    return track
