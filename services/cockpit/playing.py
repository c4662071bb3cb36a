"""Plays a capture: the same scene, the same pictures, fed from a file instead of the mesh.

Everything that reads the file runs in the thread of the one who plays it: `Playback` is used by one thread at a time.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from cocoro import topics
from cocoro.capture.conventions import CaptureError
from cocoro.capture.listed import Ends
from cocoro.capture.player import AT_ONCE, Player
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import NotReadableError
from cocoro.clock import NS
from cocoro.errors import ConfigError
from cocoro.installed import topic_named
from cocoro.messages import Frame, Health, Latch, TaskState
from cocoro.robot import Robot
from services.cockpit.scene import TOPICS, Scene

BEFORE_S = 2.5
"""What is read before a place that is jumped to, so that the newest of everything is known there."""
MOST = 40
"""Rounds of `AT_ONCE` messages that one step takes at most, so that a fast playing does not hold a step up."""


class Mark(NamedTuple):
    """Something on the time line."""

    at_s: float
    kind: str
    """task, phase, stop or fault."""
    text: str


class Playback:
    """One capture that is played. Times are seconds from its start; `now_s` is of a steady clock."""

    def __init__(self, path: Path) -> None:
        """Raises CaptureError for a file that cannot be read."""
        self.capture = Capture.open(path)
        self.robot = _robot_of(self.capture)
        self._prefix = f"{self.capture.robot}/"
        self._player = Player(self.capture, self._chosen, loop=False)
        self.duration_s = round(self._player.length_s, 3)
        self.marks = _marks(self.capture, path)
        self.scene = Scene(self.robot)
        self.frame: Frame | None = None
        """The newest frame up to the position."""
        self.now_ns = 0
        """The robot's time at the position, by the newest message."""
        self.at_s = 0.0
        self.ended = False

    def close(self) -> None:
        """Close the file."""
        self.capture.close()

    def step(self, now_s: float) -> None:
        """Take all messages that are due."""
        last: Record | None = None
        for _ in range(MOST):
            due = self._player.due(now_s)
            for record in due:
                last = self._take(record) or last
            if len(due) < AT_ONCE:
                break
        if last is not None:
            self._take_frame(last)
        self.at_s = self._player.position_s(now_s)
        self.ended = self._player.ended

    def seek(self, now_s: float, at_s: float) -> None:
        """Go to a time."""
        self._player.seek(now_s, at_s)
        self.scene, last = Scene(self.robot), None
        self.frame = None
        here_ns = self._player.position_ns(now_s)
        earliest_ns = here_ns - round(BEFORE_S * NS)
        keys = [key for key in self.capture.keys if self._chosen(key)]
        for record in self.capture.messages(*keys, start_ns=earliest_ns, end_ns=here_ns):
            last = self._take(record) or last
        if last is not None:
            self._take_frame(last)
        self.at_s = self._player.position_s(now_s)
        self.ended = self._player.ended

    def pause(self, now_s: float, on: bool) -> None:
        """Hold the playing, or go on; from the end it goes on at the beginning."""
        if not on and self._player.ended:
            self.seek(now_s, 0.0)
        if on != self._player.paused:
            self._player.toggle(now_s)

    def speed(self, now_s: float, x: float) -> None:
        """Play so many times as fast as it was recorded."""
        self._player.change_rate(now_s, x)

    @property
    def paused(self) -> bool:
        return self._player.paused

    @property
    def rate(self) -> float:
        return self._player.rate

    def _chosen(self, key: str) -> bool:
        name = key.removeprefix(self._prefix)
        row = topic_named(name)
        return row is not None and (row.name == topics.FRAME.name or any(_is_of(row, topic) for topic in TOPICS))

    def _take(self, record: Record) -> Record | None:
        """Take a message into the scene; a frame is returned, since only the last one is decoded."""
        name = record.key.removeprefix(self._prefix)
        if name == topics.FRAME.name:
            return record
        row = topic_named(name)
        try:
            message = self.capture.read(record)
        except NotReadableError:
            return None
        if row is not None and isinstance(message, row.type):
            self.scene.take(row, message)
            self.now_ns = message.stamp_ns
            if isinstance(message, Health):
                self.scene.lives(message.service, True)
        return None

    def _take_frame(self, record: Record) -> None:
        with suppress(NotReadableError):
            frame = self.capture.read(record)
            if isinstance(frame, Frame):
                self.frame = frame


def _is_of(row: Any, topic: Any) -> bool:
    return bool(row.name == topic.name or (topic.per_service and row.name.partition("/")[2] == topic.name[10:]))


def _robot_of(capture: Capture) -> Robot:
    """The recorded robot description; the project's own where there is none, or it cannot be read."""
    with suppress(KeyError, msgspec.MsgspecError, ConfigError, json.JSONDecodeError):
        return Robot.from_data(json.loads(capture.metadata["robot"]["description"]))
    return Robot.load()


def _marks(capture: Capture, path: Path) -> list[Mark]:
    """What happened: tasks with their phases, stops, faults."""
    found = [*_of_tasks(capture), *_of_latches(capture)]
    occasion = Ends(path).occasion
    found += [
        Mark(_at_s(capture, note.log_ns), "fault", note.text)
        for note in (occasion.notes if occasion is not None else ())
        if not note.text.endswith(" moves") and "emergency stop" not in note.text  # which the latch tells
    ]
    return sorted(mark for mark in found if mark.at_s >= 0.0)


def _of_tasks(capture: Capture) -> list[Mark]:
    found: list[Mark] = []
    before = ("", "", None)
    for record in capture.messages(topics.TASK.key(capture.robot)):
        with suppress(NotReadableError):
            task = capture.read(record)
            assert isinstance(task, TaskState)
            at_s = _at_s(capture, record.log_ns)
            if task.task_id != before[0]:
                found.append(Mark(at_s, "task", f"{task.task} {task.label}".strip()))
            elif task.outcome is not None and before[2] is None:
                found.append(Mark(at_s, "task", f"{task.outcome}: {task.reason}" if task.reason else task.outcome))
            if task.phase != before[1] and task.outcome is None:
                found.append(Mark(at_s, "phase", task.phase))
            before = (task.task_id, task.phase, task.outcome)  # type: ignore[assignment] # None or a word
    return [mark for mark in found if mark.text]


def _of_latches(capture: Capture) -> list[Mark]:
    found: list[Mark] = []
    before = ""
    for record in capture.messages(topics.LATCH.key(capture.robot)):
        with suppress(NotReadableError):
            latch = capture.read(record)
            assert isinstance(latch, Latch)
            if latch.state == "latched" and before != "latched":
                found.append(Mark(_at_s(capture, record.log_ns), "stop", f"emergency stop by {latch.by}"))
            before = latch.state
    return found


def _at_s(capture: Capture, log_ns: int) -> float:
    return round((log_ns - capture.start_ns) / NS, 3)


__all__ = ["CaptureError", "Mark", "Playback"]
