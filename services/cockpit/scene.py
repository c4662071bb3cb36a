"""What is shown: the newest of everything, gathered from messages. Pure, so that a capture is played by the same code.

scene.take(PLAN, message)       # live: from the mesh; a capture: from its reader
scene.state(now_ns)             # the page's `state`
scene.marks(stamp_ns)           # what is drawn into the picture of that stamp
"""

from __future__ import annotations

import zlib
from base64 import b64encode
from collections.abc import Callable
from math import hypot
from typing import Any

import msgspec

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import (
    BaseState,
    ClockOffset,
    Detection,
    Detections,
    FloorPlan,
    Health,
    Latch,
    Message,
    PlannerStatus,
    Recording,
    ServoState,
    TaskState,
)
from cocoro.robot import Robot
from cocoro.topics import Topic
from services.cockpit.sight import Sight

SHOWN_S = 2.0
"""Age from which a state is told as old."""
SEEN_S = 0.7
"""Age up to which detections are drawn into a newer picture."""
WAY_S = 1.5
"""Age up to which the planner's way is drawn into a picture."""
WAY_STEPS = 64
"""Places of the way that are drawn into a picture."""
DRIVE_TASK = "drive"
"""The task in which somebody drives by hand."""

TOPICS: tuple[Topic[Any], ...] = (
    topics.BASE_STATE,
    topics.ARM_STATE,
    topics.DETECTIONS,
    topics.PLAN,
    topics.FLOOR_PLAN,
    topics.TASK,
    topics.LATCH,
    topics.HEALTH,
    topics.OFFSET,
    topics.RECORDING,
)
"""What it takes; those with `{service}` in their name of all services."""


class Scene:
    """Gathers messages and gives the state of the robot as the page wants it."""

    def __init__(self, robot: Robot) -> None:
        self.sight = Sight(robot)
        self.task = TaskState()
        self.plan: PlannerStatus | None = None
        self.base: BaseState | None = None
        self.latch: Latch | None = None
        self.recording: Recording | None = None
        self.health: dict[str, Health] = {}
        self.hosts: dict[str, ClockOffset] = {}
        """The hosts of a site, by name."""
        self.alive: set[str] = set()
        """Services that hold their token; in a capture nobody tells, so those that are heard count."""
        self.detections: Detections | None = None
        self.floor: FloorPlan | None = None
        self._takers: dict[str, Callable[[Any], None]] = {
            topics.BASE_STATE.name: self._take_base,
            topics.ARM_STATE.name: self._take_arm,
            topics.DETECTIONS.name: self._take_detections,
            topics.PLAN.name: self._take_plan,
            topics.FLOOR_PLAN.name: self._take_floor,
            topics.TASK.name: self._take_task,
            topics.LATCH.name: self._take_latch,
        }

    # --- gathering --------------------------------------------------------------------------------

    def take(self, topic: Topic[Any], message: Message) -> None:
        """Take one message of a topic of `TOPICS`; of any other topic nothing is taken."""
        if isinstance(message, Health):
            self.health[message.service] = message
        elif isinstance(message, ClockOffset):
            self.hosts[message.host] = message
        elif isinstance(message, Recording):
            self.recording = message
        elif (taker := self._takers.get(topic.name)) is not None:
            taker(message)

    def lives(self, service: str, alive: bool) -> None:
        """A service became alive, or ceased to be."""
        (self.alive.add if alive else self.alive.discard)(service)

    def _take_base(self, base: BaseState) -> None:
        self.base = base

    def _take_arm(self, arm: ServoState) -> None:
        self.sight.take_joints(arm)

    def _take_detections(self, detections: Detections) -> None:
        self.detections = detections

    def _take_plan(self, plan: PlannerStatus) -> None:
        self.plan = plan
        self.sight.take_pose(plan)

    def _take_floor(self, floor: FloorPlan) -> None:
        self.floor = floor

    def _take_task(self, task: TaskState) -> None:
        self.task = task

    def _take_latch(self, latch: Latch) -> None:
        self.latch = latch

    # --- telling ----------------------------------------------------------------------------------

    def state(self, now_ns: int) -> dict[str, Any]:
        """The robot's state at a time, as the page wants it (`"kind": "state"`), without what belongs to a viewer."""
        return {
            "kind": "state",
            "now_ns": now_ns,
            "task": self._task(now_ns),
            "plan": self._plan(now_ns),
            "base": self._base(now_ns),
            "latch": "unknown" if self.latch is None or _age_s(self.latch, now_ns) > SHOWN_S else self.latch.state,
            "recording": self._recording(now_ns),
            "services": self._services(now_ns),
            "hosts": [
                {
                    "host": host.host,
                    "clock": host.state,
                    "ahead_s": _rounded(host.ahead_s),
                    "unanswered": host.unanswered,
                    "age_s": round(_age_s(host, now_ns), 1),
                }
                for _, host in sorted(self.hosts.items())
            ],
            "drive": {"task_id": self.task.task_id} if self.drives else None,
        }

    @property
    def drives(self) -> bool:
        """Whether somebody drives by hand."""
        return self.task.task == DRIVE_TASK and self.task.outcome is None

    def map(self) -> dict[str, Any] | None:
        """The floor map, as the page wants it; None before it was heard."""
        floor = self.floor
        if floor is None:
            return None
        return {
            "kind": "map",
            "cell_m": floor.cell_m,
            "origin": floor.origin_m,
            "width": floor.width,
            "height": floor.height,
            "cells": b64encode(zlib.compress(floor.cells, 1)).decode(),
            "way": floor.way_m,
            "goal": floor.goal_m,
        }

    def marks(self, stamp_ns: int, width: int, height: int) -> dict[str, Any]:
        """What is drawn into a picture of that stamp, in its pixels."""
        place = self.sight.at(stamp_ns)
        hand = goal = None
        way: list[tuple[float, float]] = []
        if self.plan is not None and place is not None:
            if self.plan.hand_m is not None:
                hand = place.pixel_of_body(self.plan.hand_m, width, height)
            if self.plan.target is not None:
                goal = place.pixel_of_floor(self.plan.target.odometry_position_m, width, height)
            if self.floor is not None and stamp_ns - self.floor.stamp_ns < WAY_S * NS:
                pixels = (place.pixel_of_floor((*step, 0.0), width, height) for step in self.floor.way_m[:WAY_STEPS])
                way = [pixel for pixel in pixels if pixel is not None]
        return {
            "detections": self._detected(stamp_ns, width, height),
            "hand": hand,
            "way": way,
            "goal": goal,
        }

    def _detected(self, stamp_ns: int, width: int, height: int) -> list[dict[str, Any]]:
        found = self.detections
        if found is None or abs(stamp_ns - found.stamp_ns) > SEEN_S * NS:
            return []
        across, down = width / found.width, height / found.height
        return [_mark(detection, across, down) for detection in found.detections]

    def _task(self, now_ns: int) -> dict[str, Any]:
        task = self.task
        return {
            "task": task.task,
            "label": task.label,
            "phase": task.phase,
            "text": task.text,
            "outcome": task.outcome,
            "reason": task.reason,
            "task_id": task.task_id,
            "elapsed_s": round(task.elapsed_s, 2),
            "distance_m": _rounded(task.distance_m),
            "phases": [
                {"name": phase.name, "took_s": round(((phase.end_ns or now_ns) - phase.start_ns) / NS, 2)}
                for phase in task.phases
            ],
        }

    def _plan(self, now_ns: int) -> dict[str, Any] | None:
        plan = self.plan
        if plan is None:
            return None
        return {
            "behaviour": plan.behaviour,
            "why": plan.why,
            "state": plan.state,
            "reason": plan.reason,
            "age_s": round(_age_s(plan, now_ns), 2),
            "body": None if plan.body_m is None else [*map(_rounded, plan.body_m), _rounded(plan.body_yaw_rad)],
            "hand": None if plan.hand_m is None else [_rounded(each) for each in plan.hand_m],
            "holding": plan.holding,
            "distance_m": _rounded(plan.distance_m),
            "target": None if plan.target is None else plan.target.label,
            "known": [
                {
                    "label": one.label,
                    "x": _rounded(one.odometry_position_m[0]),
                    "y": _rounded(one.odometry_position_m[1]),
                    "age_s": round(one.age_s, 1),
                    "sigma_m": _rounded(one.sigma_m),
                }
                for one in plan.known
            ],
        }

    def _base(self, now_ns: int) -> dict[str, Any] | None:
        base = self.base
        if base is None:
            return None
        touched = {"left": base.bump_left, "right": base.bump_right, "cliff": base.cliff, "wheel drop": base.wheel_drop}
        return {
            "speed_mps": _rounded(base.speed_mps),
            "turn_radps": _rounded(base.turn_rate_radps),
            "battery": round(base.battery_fraction, 3),
            "charging": base.charging,
            "bumped": [name for name, pressed in touched.items() if pressed],
            "stopped_by": base.stopped_by,
            "mode": base.mode,
            "age_s": round(_age_s(base, now_ns), 2),
        }

    def _recording(self, now_ns: int) -> dict[str, Any] | None:
        told = self.recording
        if told is None:
            return None
        return {
            "file": told.file.rpartition("/")[2],
            "size_bytes": told.size_bytes,
            "rate": round(told.rate_bytes_per_s),
            "occasion": told.occasion,
            "fault": told.fault,
            "dropped": sum(told.dropped.values()),
            "task_id": told.task_id,
            "ended": told.ended,
            "age_s": round(_age_s(told, now_ns), 1),
        }

    def _services(self, now_ns: int) -> list[dict[str, Any]]:
        names = sorted({*self.health, *self.alive})
        return [self._service(name, now_ns) for name in names]

    def _service(self, name: str, now_ns: int) -> dict[str, Any]:
        health = self.health.get(name)
        if health is None:
            return {"service": name, "state": "no report", "text": "", "alive": name in self.alive, "faults": []}
        late = [loop.name for loop in health.loops if loop.overruns]
        return {
            "service": name,
            "state": health.state,
            "text": health.text,
            "cpu": round(health.cpu_share, 3),
            "rss_mb": round(health.rss_mb, 1),
            "alive": name in self.alive,
            "faults": list(health.faults),
            "late": late,
            "age_s": round(_age_s(health, now_ns), 1),
        }


def _mark(detection: Detection, across: float, down: float) -> dict[str, Any]:
    left, top, right, bottom = detection.box_px
    return {
        "label": detection.label,
        "box": [round(left * across, 1), round(top * down, 1), round(right * across, 1), round(bottom * down, 1)],
        "u": round(detection.u_px * across, 1),
        "v": round(detection.v_px * down, 1),
        "note": detection.note,
        "distance_m": _distance(detection),
    }


def _distance(detection: Detection) -> float | None:
    """Over the floor, from the body's centre."""
    if detection.position_m is None:
        return None
    x, y, _ = detection.position_m
    return round(hypot(x, y), 2)


def _age_s(message: Message, now_ns: int) -> float:
    return (now_ns - message.stamp_ns) / NS


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def encoded(message: dict[str, Any]) -> str:
    """A message of the page's protocol as text."""
    return msgspec.json.encode(message).decode()
