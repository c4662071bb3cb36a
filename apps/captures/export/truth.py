"""What the robot believed beside what was true, where a simulator told the truth."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from math import dist
from typing import Any

from apps.captures.export.geometry import conjugate, rotated
from apps.captures.export.story import read
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.messages import TrueObject, Truth
from cocoro.topics import PLAN, TRUTH
from cocoro.units import Vec3

FARTHEST_NS = NS // 10
"""Truth that is further from the belief's stamp is not of its time."""


class Truths:
    """The truth by stamp; between two the places are interpolated, the body's turn is the nearer one's."""

    def __init__(self, capture: Capture) -> None:
        told = sorted(((truth.stamp_ns, n, truth) for n, (_, truth) in enumerate(read(capture, TRUTH))))
        self._stamps_ns = [stamp_ns for stamp_ns, _, _ in told]
        self._truths = [truth for _, _, truth in told]

    def __bool__(self) -> bool:
        return bool(self._truths)

    def in_body(self, label: str, stamp_ns: int) -> Vec3 | None:
        """Where an object was, body frame; None when that is not known of the time."""
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
    if found is None:
        return None
    x, y, z = (there - here for there, here in zip(found.position_m, truth.body_m, strict=True))
    return rotated(conjugate(truth.body_orientation), (x, y, z))


def beliefs(capture: Capture) -> Iterator[dict[str, Any]]:
    """A row for each object that the planner told of, in the body frame at the status' stamp."""
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
