"""A small made-up robot for the page's tests: it has a pose, a picture, a map, tasks and objects, and needs no mesh."""

from __future__ import annotations

import base64
import itertools
import math
import time
import zlib
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from cocoro.clock import NS

WIDTH, HEIGHT, FOCAL_PX, CAMERA_M, TILT_RAD = 640, 480, 525.0, 0.62, 0.42
HOLD_S = 0.2
CELL_M = 0.05
WHY = {
    "approach": "drives around the box on its right",
    "drive": "driven by hand",
    "search": "looks for it on the left",
}
SHAPES = {"red_can": "cylinder", "green_can": "cylinder", "blue_can": "cylinder", "yellow_ball": "sphere"}
OBJECTS = [{"label": label, "shape": shape, "graspable": True} for label, shape in SHAPES.items()]
OBJECTS += [{"label": "hand_marker", "shape": "box", "graspable": False}]
PLACES_M = {"red_can": (1.9, 0.25), "green_can": (2.3, -0.5), "blue_can": (-0.6, 1.4)}
COLOURS = {"red_can": (38, 42, 212), "green_can": (60, 150, 30), "blue_can": (200, 70, 40)}
"""Blue, green, red."""


def _option(name: str, kind: str = "float", **more: Any) -> dict[str, Any]:
    return {"name": name, "type": kind, "default": None, "needed": False, "description": ""} | more


def _task(name: str, label: str, doc: str, *options: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "label": label, "doc": doc, "options": options}


TASKS = [
    _task("drive", "", "Drive by hand."),
    _task(
        "fetch",
        "graspable",
        "Find an object, drive there, grasp it and lift it.",
        _option("bring", "bool", default=False, description="Bring it to where the task began and put it down."),
    ),
    _task("follow", "known", "Keep behind it.", _option("for_s", min=0, max=3600, description="Follow for so long.")),
    _task("go-there", "", "Drive to a place.", _option("x_m", needed=True), _option("y_m", needed=True)),
    _task("go-to", "known", "Drive to it.", _option("distance_m", default=0.2, description="Distance to its edge, m.")),
    _task("park", "", "Fold the arm."),
    _task("put-down", "", "Set down what the hand holds: here, or at a place.", _option("x_m"), _option("y_m")),
    _task("touch", "graspable", "Bring the open hand around something."),
    _task("wave", "", "Somebody else's task."),
]


@dataclass
class World:
    """The robot, moved on by whoever asks for its state."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    latch: str = "released"
    task: dict[str, Any] = field(default_factory=dict)
    moves_until_s: float = 0.0
    speed_mps: float = 0.0
    turn_radps: float = 0.0
    tick: int = 100
    ticks_s: dict[int, float] = field(default_factory=dict)
    drives: bool = False
    driven: list[dict[str, float]] = field(default_factory=list)
    """The motions that counted."""

    def __post_init__(self) -> None:
        self._ids = itertools.count(1)
        self._last_s = time.monotonic()

    def begin(self, task: dict[str, Any], instead: bool) -> tuple[bool, str]:
        """Begin a task, or say why not."""
        if self.latch == "latched":
            return False, "refused: the robot is stopped; reset it first"
        if self.running and not instead:
            return False, f"refused: busy with {self.task['task']}; cancel it first"
        self.drives = False
        first = "search" if task.get("label") else task["task"]
        self.task = {
            "task": task["task"],
            "label": task.get("label", ""),
            "phase": first,
            "text": "",
            "outcome": None,
            "reason": "",
            "task_id": f"task-{next(self._ids)}",
            "elapsed_s": 0.0,
            "phases": [{"name": first}],
            "distance_m": None,
            "began_s": time.monotonic(),
            "options": task,
        }
        return True, ""

    @property
    def running(self) -> bool:
        return bool(self.task) and self.task["outcome"] is None

    def end(self, outcome: str, reason: str = "") -> None:
        if self.running:
            self.task |= {"outcome": outcome, "reason": reason, "phase": "idle"}
        self.drives = False
        self.speed_mps = self.turn_radps = 0.0

    def new_tick(self) -> int:
        self.tick += 1
        self.ticks_s[self.tick] = time.monotonic()
        return self.tick

    def drive(self, tick: int, motion: dict[str, float]) -> dict[str, Any]:
        """Take a motion that quotes that tick; returns the next one, and whether the motion counts."""
        issued_s = self.ticks_s.get(tick, -1.0)
        counts = self.drives and self.latch == "released" and time.monotonic() - issued_s <= HOLD_S
        if counts:
            self.moves_until_s = issued_s + HOLD_S
            self.speed_mps, self.turn_radps = motion.get("speed_mps", 0.0), motion.get("turn_radps", 0.0)
            self.driven.append(motion)
        return {"tick": self.new_tick(), "accepted": counts}

    def step(self) -> None:
        """Move on to now."""
        now_s = time.monotonic()
        passed_s, self._last_s = now_s - self._last_s, now_s
        if self.running:
            self.task["elapsed_s"] = now_s - self.task["began_s"]
        if self.drives and now_s > self.moves_until_s:
            self.speed_mps = self.turn_radps = 0.0
        if self.running and self.task["task"] in ("fetch", "go-to", "follow") and not self.drives:
            self._go()
        self.yaw_rad += self.turn_radps * passed_s
        self.x_m += self.speed_mps * math.cos(self.yaw_rad) * passed_s
        self.y_m += self.speed_mps * math.sin(self.yaw_rad) * passed_s

    def _go(self) -> None:
        x_m, y_m = PLACES_M.get(self.task["label"], (2.0, 0.0))
        away_m = math.hypot(x_m - self.x_m, y_m - self.y_m)
        turn_rad = math.atan2(y_m - self.y_m, x_m - self.x_m) - self.yaw_rad
        self.turn_radps = max(-0.8, min(0.8, 2.0 * math.remainder(turn_rad, math.tau)))
        self.speed_mps = min(0.25, max(0.0, away_m - 0.45))
        phase = "approach" if self.speed_mps > 0.01 else "reach"
        if self.task["phase"] != phase:
            self.task["phase"] = phase
            self.task["phases"].append({"name": phase})
        self.task["distance_m"] = max(0.0, away_m - 0.45)

    def seen(self) -> list[dict[str, Any]]:
        """The cans in the picture, as marks in pixels."""
        found = []
        for label, (x_m, y_m) in PLACES_M.items():
            low, high = self.pixel(x_m, y_m, 0.0), self.pixel(x_m, y_m, 0.12)
            if low is None or high is None:
                continue
            half_px = max(3, round((low[1] - high[1]) * 0.275))
            box = [round(low[0]) - half_px, round(high[1]), round(low[0]) + half_px, round(low[1])]
            if box[0] > 0 and box[2] < WIDTH and box[1] > 0 and box[3] < HEIGHT:
                middle = {"u": (box[0] + box[2]) / 2, "v": (box[1] + box[3]) / 2}
                found.append({"label": label, "box": box, "note": "", **middle})
        return found

    def pixel(self, x_m: float, y_m: float, z_m: float) -> tuple[float, float] | None:
        """Where that place of the odometry frame is in the picture; None behind the camera."""
        dx_m, dy_m = x_m - self.x_m, y_m - self.y_m
        ahead_m = dx_m * math.cos(self.yaw_rad) + dy_m * math.sin(self.yaw_rad)
        left_m = -dx_m * math.sin(self.yaw_rad) + dy_m * math.cos(self.yaw_rad)
        up_m = z_m - CAMERA_M
        depth_m = ahead_m * math.cos(TILT_RAD) - up_m * math.sin(TILT_RAD)
        if depth_m < 0.15:
            return None
        down_m = -ahead_m * math.sin(TILT_RAD) - up_m * math.cos(TILT_RAD)
        return WIDTH / 2 - FOCAL_PX * left_m / depth_m, HEIGHT / 2 + FOCAL_PX * down_m / depth_m

    def picture(self) -> tuple[dict[str, Any], bytes]:
        """The marks of a picture now, and the picture as JPEG, 640 x 480."""
        rows = np.linspace(168, 120, HEIGHT, dtype=np.float32)[:, None, None]
        image = np.ascontiguousarray((rows * np.array([0.92, 0.98, 1.0], dtype=np.float32)).repeat(WIDTH, 1)).astype(
            np.uint8
        )
        horizon = round(HEIGHT / 2 - FOCAL_PX * math.tan(TILT_RAD))
        image[: max(0, horizon + 60)] = (176, 186, 190)
        for line_m in np.arange(-6, 7, 0.5):
            for ends in (((line_m, -6), (line_m, 6)), ((-6, line_m), (6, line_m))):
                self._line(image, *ends)
        for mark in self.seen():
            left, top, right, bottom = mark["box"]
            colour = COLOURS[mark["label"]]
            cv2.rectangle(image, (left, top), (right, bottom), [value * 0.7 for value in colour], -1)
            cv2.rectangle(image, (left, top), ((left + 2 * right) // 3, bottom), colour, -1)
            cv2.ellipse(image, ((left + right) // 2, top), ((right - left) // 2, 4), 0, 0, 360, colour, -1)
        marks: dict[str, Any] = {"detections": self.seen(), "hand": None, "way": [], "goal": None}
        if (way := self.way()) and self.running:
            points = [self.pixel(x_m, y_m, 0.0) for x_m, y_m in way]
            marks["way"] = [point for point in points if point is not None and point[1] < HEIGHT - 1]
            marks["goal"] = marks["way"][-1] if marks["way"] else None
        return marks, cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()

    def _line(self, image: Any, one_m: tuple[float, float], other_m: tuple[float, float]) -> None:
        ends = np.array([one_m, other_m])
        points = [
            self.pixel(x_m, y_m, 0.0) for x_m, y_m in ends[0] + np.linspace(0, 1, 33)[:, None] * (ends[1] - ends[0])
        ]
        for start, end in itertools.pairwise(points):
            if start is not None and end is not None and max(map(abs, start + end)) < 4000:
                first, last = (round(start[0]), round(start[1])), (round(end[0]), round(end[1]))
                cv2.line(image, first, last, (118, 124, 122), 1, cv2.LINE_AA)

    def way(self) -> list[list[float]]:
        x_m, y_m = PLACES_M.get(self.task.get("label", ""), (0.0, 0.0))
        if not self.running or not self.task["label"]:
            return []
        bend_m = 0.12
        return [
            [
                self.x_m + (x_m - self.x_m) * share,
                self.y_m + (y_m - self.y_m) * share + bend_m * math.sin(math.pi * share),
            ]
            for share in np.linspace(0.12, 0.82, 15).tolist()
        ]

    def map(self) -> dict[str, Any]:
        """The message `map`."""
        side = 120
        cells = np.zeros((side, side), np.uint8)
        y_m, x_m = np.mgrid[0:side, 0:side] * CELL_M - 2.0
        reach_m = np.hypot(x_m, y_m)
        cells[(reach_m < 2.9) & (np.abs(np.arctan2(y_m, x_m)) < 2.2)] = 1
        cells[np.abs(reach_m - 2.9) < 0.05] = 2
        cells[(np.abs(x_m - 1.2) < 0.16) & (np.abs(y_m + 0.9) < 0.2)] = 2
        for place_m in PLACES_M.values():
            cells[np.hypot(x_m - place_m[0], y_m - place_m[1]) < 0.05] = 2
        return {
            "kind": "map", "cell_m": CELL_M, "origin": [-2.0, -2.0], "width": side, "height": side,
            "cells": base64.b64encode(zlib.compress(cells.tobytes())).decode(), "way": self.way(), "goal": None,
        }  # fmt: skip

    def plan(self) -> dict[str, Any]:
        seen = {mark["label"] for mark in self.seen()}
        known = [
            {"label": label, "x": x_m, "y": y_m, "age_s": 0.05, "sigma_m": 0.01}
            if label in seen
            else {"label": label, "x": x_m, "y": y_m, "age_s": 42.0, "sigma_m": 0.12}
            for label, (x_m, y_m) in PLACES_M.items()
        ]
        phase = self.task.get("phase", "idle") if self.running else "idle"
        return {
            "behaviour": phase,
            "why": WHY.get(phase, "stands still: nothing to do"),
            "state": "running",
            "body": [self.x_m, self.y_m, self.yaw_rad],
            "hand": [0.2, 0.0, 0.3],
            "holding": self.task.get("task") == "fetch" and self.task["outcome"] == "done",
            "known": known,
            "target": (self.task.get("label") or None) if self.running else None,
        }

    def state(self) -> dict[str, Any]:
        """The message `state`."""
        self.step()
        shown = {key: value for key, value in self.task.items() if key not in ("began_s", "options")}
        return {
            "kind": "state",
            "now_ns": time.time_ns(),
            "task": shown or None,
            "plan": self.plan(),
            "base": {
                "speed_mps": self.speed_mps,
                "turn_radps": self.turn_radps,
                "battery": 0.83,
                "charging": False,
                "bumped": [],
                "stopped_by": "" if self.latch == "released" else "estop",
            },
            "latch": self.latch,
            "recording": {"file": "robot.mcap", "size_bytes": 12_400_000, "fault": "", "dropped": 0},
            "services": [
                {
                    "service": name,
                    "state": "ready",
                    "text": "",
                    "cpu": 0.06,
                    "rss_mb": 74.0,
                    "alive": True,
                    "faults": [],
                }
                for name in ("base", "capture", "executive", "kinect", "perception", "planning", "servos")
            ],
            "hosts": [],
            "drive": {"task_id": self.task["task_id"]} if self.drives else None,
        }


def captures() -> list[dict[str, Any]]:
    """The answer to `GET /captures`."""
    began_ns = 1_796_000_000 * NS
    rows = [
        ("", "", 12.0, 1_300_000, False),
        ("fetch red_can", "done", 31.5, 22_400_000, True),
        ("follow blue_ball", "cancelled", 62.0, 48_100_000, False),
        ("fetch green_can", "failed", 44.2, 31_000_000, False),
        ("", "", 1820.0, 9_300_000, False),
    ]
    return [
        {
            "name": f"calliope-20261128-{index:02}",
            "size_bytes": size,
            "pinned": pinned,
            "closed": True,
            "began_ns": began_ns - index * 5400 * NS,
            "duration_s": duration_s,
            "what": what,
            "outcome": outcome,
            "written": index == 0,
        }
        for index, (what, outcome, duration_s, size, pinned) in enumerate(rows)
    ]
