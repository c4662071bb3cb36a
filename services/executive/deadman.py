"""Whose motion counts while an operator drives by hand, and for how long.

Every answer brings a tick, a number that is used once. A motion counts only when its request quotes a tick that was
issued at most `HOLD_S` before, and until `HOLD_S` after that tick was issued. So a request that waited in a queue, was
sent twice or comes from a task that has ended moves nothing, and a held control needs a round trip all the time.
"""

from __future__ import annotations

from typing import NamedTuple

from cocoro.clock import NS
from cocoro.messages import DriveReply, Motion
from cocoro.messages.driving import HOLD_S

LETS_GO_S = 1.0
"""Another driver moves the robot when the last one has not for so long."""
KNOWN_S = 3.0
"""A tick of up to this age still shows which driver it was given to."""
_MOST = 512
"""Ticks that are remembered."""


class Moment(NamedTuple):
    """The present by two clocks. A tick's age is the greater one of both: the machine's clock goes on while a
    simulator's stands, the robot's counts the time for which the machine was suspended."""

    loop_s: float
    """The event loop's time."""
    robot_ns: int

    def age_s(self, since: Moment) -> float:
        """Time since another moment, s; infinite when one of the clocks began anew between them."""
        ages_s = self.loop_s - since.loop_s, (self.robot_ns - since.robot_ns) / NS
        return max(ages_s) if min(ages_s) >= 0 else float("inf")


class _Tick(NamedTuple):
    issued: Moment
    driver: int
    used: bool


class Deadman:
    """One drive by hand. Ticks of another one are unknown to it."""

    def __init__(self, first_tick: int, now: Moment) -> None:
        """`first_tick`: above all ticks that were issued before."""
        self.next_tick = first_tick
        self._ticks: dict[int, _Tick] = {}
        self._drivers = 0
        self._holder: int | None = None
        """The driver who moved the robot last."""
        self._moved = now
        """When a motion counted last; the begin before the first."""
        self._motion: Motion | None = None
        self._issued = now
        """When the tick of that motion was issued."""

    def since_input_s(self, now: Moment) -> float:
        """Time since a motion counted last, or since the begin."""
        return now.age_s(self._moved)

    def motion(self, now: Moment) -> tuple[Motion, int] | None:
        """The motion that counts now, and the time, ns of the robot's clock, until which it does; None for rest."""
        if self._motion is None:
            return None
        left_s = HOLD_S - now.age_s(self._issued)
        if left_s <= 0:
            self._motion = None
            return None
        return self._motion, now.robot_ns + round(left_s * NS)

    def take(self, tick: int, motion: Motion, now: Moment, why_not: str = "") -> DriveReply:
        """Answer a request. `why_not`: a reason for which no motion counts now."""
        quoted = self._ticks.get(tick)
        if quoted is None:
            self._drivers += 1
        driver = quoted.driver if quoted is not None else self._drivers
        fresh = quoted is not None and not quoted.used and now.age_s(quoted.issued) <= HOLD_S
        if quoted is not None:
            self._ticks[tick] = quoted._replace(used=True)
        answer = DriveReply(accepted=True, tick=self._issue(driver, now))
        if motion.zero:
            if driver == self._holder:
                self._motion = None
            return answer
        if quoted is None or not fresh:
            return _refused(answer, "no_tick", "the request quotes no tick of the last 0.2 s")
        if why_not:
            return _refused(answer, "waiting", why_not)
        if driver != self._holder and self._holder is not None and now.age_s(self._moved) < LETS_GO_S:
            return _refused(answer, "other_driver", "another driver moves the robot")
        self._holder, self._moved = driver, now
        self._motion, self._issued = motion, quoted.issued
        return answer

    def _issue(self, driver: int, now: Moment) -> int:
        tick, self.next_tick = self.next_tick, self.next_tick + 1
        self._ticks[tick] = _Tick(now, driver, used=False)
        for old in list(self._ticks):
            if len(self._ticks) <= _MOST and now.age_s(self._ticks[old].issued) <= KNOWN_S:
                break
            del self._ticks[old]
        return tick


def _refused(answer: DriveReply, code: str, text: str) -> DriveReply:
    answer.accepted, answer.refusal, answer.text = False, code, text  # type: ignore[assignment]
    return answer
