"""Records how robot and objects moved in a rehearsal, by the truth and by the robot's belief, for plots and figures."""

from __future__ import annotations

from math import atan2, dist, hypot
from typing import Any

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import to_spherical, wrap_rad
from cocoro.messages import PlannerStatus, TaskState, Truth
from cocoro.robot import Robot
from cocoro.units import Vec3
from sim.rigid import rotation

STALL_M = 0.005
"""A hand that stays within this distance stands still."""


class Trace:
    """Feed it every truth, planner status and task state. `robot` is the description of the true body."""

    def __init__(self, robot: Robot, target: str) -> None:
        self._hand = robot.chain(robot.arm.tip)
        self._target = target
        self._began_ns: int | None = None
        self._rows: list[dict[str, Any]] = []
        self._status = PlannerStatus()
        self._phase = ""
        self._objects: dict[str, Vec3] = {}
        self._place_m: Vec3 | None = None
        """Newest place of the hand, body frame."""
        self._moves: list[tuple[float, Vec3]] = []
        """Time and place of the hand since it began to reach."""

    def begin(self, target: str) -> None:
        """Start the recording of a task with this target."""
        self._target = target
        self._moves = []

    def status(self, status: PlannerStatus) -> None:
        self._status = status

    @property
    def model(self) -> str:
        """The body model that the planner reports to reach with."""
        return self._status.model

    def state(self, state: TaskState) -> None:
        self._phase = state.phase

    def feed(self, truth: Truth) -> None:
        self._began_ns = truth.stamp_ns if self._began_ns is None else self._began_ns
        time_s = (truth.stamp_ns - self._began_ns) / NS
        turn = rotation(truth.body_orientation)
        place = np.array(truth.body_m)
        self._objects = {
            item.label: _vec3(turn.T @ (np.array(item.position_m) - place)) for item in truth.objects
        }  # in the body's frame
        hand = _vec3(self._hand.position(truth.joints_rad))
        self._place_m = hand
        if self._phase == "touch":
            self._moves.append((time_s, hand))
        world = next((item.position_m for item in truth.objects if item.label == self._target), None)
        felt = self._status.hand_m
        self._rows.append(
            {
                "time_s": round(time_s, 3),
                "phase": self._phase,
                "target": self._target,
                "body": [*_rounded(truth.body_m[:2]), round(atan2(turn[1, 0], turn[0, 0]), 4)],
                "hand_m": _rounded(hand),
                "felt_m": _rounded(felt) if felt is not None else None,
                "target_m": _rounded(world) if world is not None else None,
            }
        )

    def hand_gap(self) -> dict[str, float] | None:
        """Distance of the true hand from the true target, m, and their difference in egocentric spherical coordinates
        (rho, azimuth, elevation). None when either is unknown."""
        hand = self._place_m
        if self._target not in self._objects or hand is None:
            return None
        target = self._objects[self._target]
        want, have = to_spherical(target), to_spherical(hand)
        return {
            "gap_m": dist(target, hand),
            "rho_m": have.rho_m - want.rho_m,
            "azimuth_rad": wrap_rad(have.azimuth_rad - want.azimuth_rad),
            "elevation_rad": have.elevation_rad - want.elevation_rad,
        }

    def edge_m(self, radius_m: float) -> float | None:
        """Horizontal distance from the robot's centre to the target's nearest edge, m. None without a target."""
        place = self._objects.get(self._target)
        return hypot(place[0], place[1]) - radius_m if place is not None else None

    def longest_stall_s(self) -> float:
        """Longest time for which the hand stayed within `STALL_M` of one place while reaching. The time after it came
        to its last place does not count: standing at the goal is no stall."""
        if not self._moves:
            return 0.0
        times = np.array([time_s for time_s, _ in self._moves])
        places = np.array([place for _, place in self._moves])
        away = np.linalg.norm(places - places[-1], axis=1) > 2 * STALL_M
        end = int(np.flatnonzero(away)[-1]) if away.any() else 0
        longest = 0.0
        start = 0
        for number in range(end + 1):
            while float(np.linalg.norm(places[number] - places[start])) > STALL_M:
                start += 1
            longest = max(longest, float(times[number] - times[start]))
        return longest

    def data(self) -> dict[str, list[Any]]:
        """The recorded columns by name."""
        return {name: [row[name] for row in self._rows] for name in (self._rows[0] if self._rows else ())}


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = values.tolist()
    return x, y, z


def _rounded(values: tuple[float, ...]) -> list[float]:
    return [round(value, 4) for value in values]
