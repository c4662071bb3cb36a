"""The orders to the servos of one group, which the event loop gives and the thread of their line writes.

Each group on a line has its own, since each can be stopped without the other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from services.servos.family import ServoReading

ORDERS_S = 0.2
"""Orders expire when they are not renewed for this long, as when the event loop hangs."""


class GroupOrders:
    def __init__(self, *, keeps_goal: bool = False) -> None:
        """`keeps_goal`: when halted, servos still go to their last goal, so that the hand keeps its grip."""
        self._keeps_goal = keeps_goal
        self._orders: tuple[float, Mapping[int, tuple[int, int]]] = (0.0, {})
        self._halted = False
        self._held: dict[int, tuple[int, int]] = {}
        """Position at which each servo is held since it was halted, and the speed to hold it with; counts."""

    def give(self, goals: Mapping[int, tuple[int, int]]) -> None:
        """Set goal and speed, counts, by servo ID. Must be renewed within `ORDERS_S`."""
        self._orders = (time.monotonic() + ORDERS_S, goals)  # one assignment: the thread sees the old or the new

    def halt(self) -> None:
        """Write no orders from now on, and make moving servos hold where they are. Thread-safe, and independent of the
        event loop."""
        self._halted = True

    def go_on(self) -> None:
        """Write orders again. Call it after `give` with orders that respect the emergency stop."""
        self._halted = False

    # --- in the line's thread -----------------------------------------------------------------------

    def due(self, now_s: float) -> Mapping[int, tuple[int, int]]:
        """What to write now: the newest orders, or when halted, the positions at which the servos are held."""
        if self._halted:
            return self._held
        self._held = {}
        until_s, goals = self._orders
        return goals if now_s < until_s else {}

    def hold(self, readings: Mapping[int, ServoReading], speed: int) -> Mapping[int, tuple[int, int]]:
        """When halted, hold the servos under orders where they were just read. A servo that does not answer follows in
        a later cycle. Returns what to write, nothing when it holds what it can. Who keeps goals holds nothing: no new
        goals are taken."""
        if not self._halted or self._keeps_goal:
            return {}
        new = [number for number in self._orders[1] if number in readings and number not in self._held]
        if not new:
            return {}
        self._held |= {number: (readings[number].position, speed) for number in new}
        return self._held
