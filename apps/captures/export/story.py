"""A capture's content besides pictures, held in memory: tasks, plans and detections; belief compared with the
truth."""

from __future__ import annotations

import base64
import json
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from math import dist
from typing import Any, Generic, TypeVar

import msgspec

from apps.captures.export.geometry import in_body
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import NotReadableError
from cocoro.clock import NS
from cocoro.messages import Detections, Message, PlannerStatus, TaskState, TrueObject, Truth
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import DETECTIONS, PLAN, TASK, TRUTH, Topic
from cocoro.units import Vec3

M = TypeVar("M", bound=Message)


class TopicTrack(Generic[M]):
    """One topic's messages by log time."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._messages: list[M] = []

    def add(self, log_ns: int, message: M) -> None:
        self._times_ns.append(log_ns)
        self._messages.append(message)

    def at(self, log_ns: int) -> M | None:
        """The newest message at a time; None before the first."""
        place = bisect_right(self._times_ns, log_ns)
        return self._messages[place - 1] if place else None


class Story:
    """Reads a capture once, without its pictures."""

    def __init__(self, capture: Capture) -> None:
        self.tasks: TopicTrack[TaskState] = _track(capture, TASK)
        self.plans: TopicTrack[PlannerStatus] = _track(capture, PLAN)
        self._seen: dict[tuple[int, int], Detections] = {}
        for _, seen in read(capture, DETECTIONS):
            self._seen[seen.frame_incarnation, seen.frame_seq] = seen

    def seen_in(self, incarnation: int, seq: int) -> Detections | None:
        """The detections of a frame."""
        return self._seen.get((incarnation, seq))


class PhaseNews:
    """The phases and outcomes of tasks, in words, each told once."""

    def __init__(self) -> None:
        self._phase = ""

    def told_by(self, task: TaskState) -> str:
        """The words for a new phase, with the reason where there is one; '' for a phase that was told already."""
        phase = f"{task.task} {task.label}: {task.outcome or task.phase}".strip()
        is_new = task.task_id and phase != self._phase
        self._phase = phase
        if not is_new:
            return ""
        return f"{phase} ({task.reason})" if task.reason else phase


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
    """The recorded robot description; the Calliope's when there is none."""
    description = capture.metadata.get("robot", {}).get("description")
    return (
        Robot.load()
        if description is None
        else Robot.from_data(msgspec.json.decode(description), f"{capture.path}, robot")
    )


def catalogue_of(capture: Capture) -> Catalogue:
    """Perception's recorded object catalogue; today's when there is none."""
    files = json.loads(capture.metadata.get("service/perception", {}).get("files", "[]"))
    content = next((base64.b64decode(file["content"]) for file in files if file["field"] == "objects"), b"")
    return (
        Catalogue.from_text(content.decode(errors="replace"), f"{capture.path}, objects")
        if content
        else Catalogue.load()
    )


def _track(capture: Capture, topic: Topic[M]) -> TopicTrack[M]:
    track: TopicTrack[M] = TopicTrack()
    for record, message in read(capture, topic):
        track.add(record.log_ns, message)
    return track


FARTHEST_NS = NS // 10
"""Largest distance between the stamps of a belief and of the truth that it is compared with."""


class Truths:
    """The simulator's truth by stamp. Positions are interpolated between two stamps, each in its own body frame."""

    def __init__(self, capture: Capture) -> None:
        truths = sorted(((truth.stamp_ns, n, truth) for n, (_, truth) in enumerate(read(capture, TRUTH))))
        self._stamps_ns = [stamp_ns for stamp_ns, _, _ in truths]
        self._truths = [truth for _, _, truth in truths]

    def __bool__(self) -> bool:
        return bool(self._truths)

    def in_body(self, label: str, stamp_ns: int) -> Vec3 | None:
        """An object's true position in the body frame, m; None when it is not known at that time."""
        after = bisect_left(self._stamps_ns, stamp_ns)
        around = [n for n in (after - 1, after) if 0 <= n < len(self._truths)]
        around = [n for n in around if abs(self._stamps_ns[n] - stamp_ns) <= FARTHEST_NS]
        places = [_in_body(self._truths[n], label) for n in around]
        if not places or any(place is None for place in places):
            return None
        first, last = places[0], places[-1]
        assert first is not None
        assert last is not None
        if len(around) == 1 or self._stamps_ns[around[0]] == self._stamps_ns[around[1]]:
            return first
        share = (stamp_ns - self._stamps_ns[around[0]]) / (self._stamps_ns[around[1]] - self._stamps_ns[around[0]])
        x, y, z = (one + share * (other - one) for one, other in zip(first, last, strict=True))
        return x, y, z


def _in_body(truth: Truth, label: str) -> Vec3 | None:
    found: TrueObject | None = next((item for item in truth.objects if item.label == label), None)
    return None if found is None else in_body(truth, found.position_m)


def beliefs(capture: Capture) -> Iterator[dict[str, Any]]:
    """One row per object and planner status, in the body frame at the status' stamp."""
    truths = Truths(capture)
    if not truths:
        return
    for record, plan in read(capture, PLAN):
        for known in plan.known:
            true = truths.in_body(known.label, plan.stamp_ns)
            if true is None:
                continue
            yield {
                "time_s": (record.log_ns - capture.start_ns) / NS,
                "stamp_ns": plan.stamp_ns,
                "label": known.label,
                "believed_x_m": known.position_m[0],
                "believed_y_m": known.position_m[1],
                "believed_z_m": known.position_m[2],
                "true_x_m": true[0],
                "true_y_m": true[1],
                "true_z_m": true[2],
                "error_m": dist(known.position_m, true),
                "sigma_m": known.sigma_m,
                "age_s": known.age_s,
                "behaviour": plan.behaviour,
            }
