"""A host's time: its gateway compares it with that of the host that keeps the robot's time, and corrects it.

Each gateway tells its host's time when asked. The others ask the keeper's a few times a second and estimate by how much
their host is off (`deploy.site.offset_estimate`). The offset that all processes of the host read
(`deploy.robot_time`) is set once, before they start; later it is slewed, so that no process sees a step, and none sees
time go back. A host whose clock may be off by more than the limit is refused: the gateway passes on nothing but what
the comparison needs (`deploy.site.rules`).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from math import inf

from cocoro.clock import NS, steady_ns
from cocoro.messages import ClockOffset, TimeReply, TimeRequest
from cocoro.node import Node
from cocoro.topics import OFFSET, TIME
from deploy.robot_time import ALONE, COMPARED, OWN, Setting
from deploy.site.asking import exchange
from deploy.site.clock_words import amount, apart
from deploy.site.offset_estimate import (
    PPM,
    SLEW_PPM,
    Estimate,
    OffsetEstimator,
    Trust,
    correction_ns,
)

ASK_EVERY_S = 0.25
FIRST_ANSWERS = 8
"""The first comparison takes the best of so many."""
FIRST_EVERY_S = 0.05
PATIENCE_S = 10.0
"""Longest wait for the first comparison, and time without one after which a host is refused."""
PUBLISH_EVERY_S = 1.0
BACK_NS = 10_000
"""Time is taken back by at most so much at once: less than a message takes from one process to another."""
LONGEST_NS = NS
"""A correction is for at most so much time: a gateway that did not run makes up for nothing."""

log = logging.getLogger("cocoro.gateway")


def tell_time(node: Node, now_ns: Callable[[], int]) -> None:
    """Answers what the time is on this host."""

    async def answer(_: TimeRequest) -> TimeReply:
        received_ns = now_ns()
        return TimeReply(received_ns=received_ns, answered_ns=now_ns())

    node.serve(TIME.of(node.name), answer)


class Timekeeping:
    """One host's time. Call `follow` and `begin`, then spawn `run`."""

    def __init__(
        self,
        node: Node,
        host: str,
        setting: Setting,
        *,
        corrects: bool = True,
        steady: Callable[[], int] = steady_ns,
    ) -> None:
        """`corrects` is False where the robot's time is the simulator's: then clocks are only compared."""
        self.keeper = host
        """The host that keeps the robot's time."""
        self._node = node
        self._host = host
        self._setting = setting
        self._corrects = corrects
        self._steady = steady
        self._estimator = OffsetEstimator()
        self._trust = Trust(inf)
        self._unanswered = 0
        self._begun_ns = steady()
        self._corrected_ns = self._begun_ns

    @property
    def refused(self) -> bool:
        return self._trust.refused and self._corrects and self.keeper != self._host

    def follow(self, keeper: str, limit_s: float) -> None:
        """Says who keeps the robot's time, and by how much this host's may be off."""
        if keeper != self.keeper:
            self._estimator = OffsetEstimator()
        self.keeper = keeper
        self._trust.limit_ns = limit_s * NS

    async def begin(self) -> None:
        """Sets this host's time by the keeper's as long as nothing else reads it; waits for that, for a while."""
        self._begun_ns = self._steady()
        if self._corrects and self.keeper != self._host and self._setting.settable:
            answers, until_ns = 0, self._begun_ns + round(PATIENCE_S * NS)
            while answers < FIRST_ANSWERS and self._steady() < until_ns:
                answers += await self._ask()
                await asyncio.sleep(FIRST_EVERY_S)
        found = self._estimate()
        if found is not None and self._setting.settable:
            by_ns = round(found.ahead_ns) - self._setting.offset_ns
            self._setting.correct(round(found.ahead_ns))
            log.info("this host's time is set by %s: it was %s", self.keeper, apart(-by_ns / NS, self.keeper))
        if self._setting.settable:
            waited = self._corrects and self.keeper != self._host
            self._setting.begin(COMPARED if found is not None else ALONE if waited else OWN)
        self._corrected_ns = self._steady()
        self._look()

    async def run(self) -> None:
        self._node.spawn(self._publish())
        while True:
            await asyncio.sleep(ASK_EVERY_S)
            if self.keeper != self._host:
                await self._ask()
                await self._correct()
                self._look()

    async def _ask(self) -> bool:
        new = await exchange(self._node, self.keeper, self._steady)
        if new is None:
            self._unanswered += 1
            return False
        restarts = self._estimator.restarts
        self._estimator.add(new)
        if self._estimator.restarts > restarts:
            log.warning("the clock of %s or of this host was set: the comparison begins anew", self.keeper)
        return True

    def _estimate(self) -> Estimate | None:
        return self._estimator.at(self._steady())

    async def _correct(self) -> None:
        """Slews the offset towards the estimate."""
        found, now_ns = self._estimate(), self._steady()
        passed_ns = min(now_ns - self._corrected_ns, LONGEST_NS)
        self._corrected_ns = now_ns
        if found is None or not self._corrects:
            return
        left_ns = correction_ns(found.ahead_ns - self._setting.offset_ns, found.slope, passed_ns)
        while left_ns < -BACK_NS:
            self._setting.correct(self._setting.offset_ns - BACK_NS)
            left_ns += BACK_NS
            await asyncio.sleep(BACK_NS / (SLEW_PPM * PPM) / NS / 2)
        self._setting.correct(self._setting.offset_ns + left_ns)

    def _look(self) -> None:
        was, found = self.refused, self._estimate()
        if found is not None:
            self._trust.look(abs(found.ahead_ns - self._setting.offset_ns) + found.uncertainty_ns)
        elif self._steady() - self._begun_ns >= PATIENCE_S * NS:
            self._trust.refuse()
        if self.refused != was:
            log.warning("%s", self.trouble or f"its clock agrees with that of {self.keeper} again")

    # --- what it says ---------------------------------------------------------------------------------

    @property
    def trouble(self) -> str:
        """Why this host is refused; '' when it is not."""
        if not self.refused:
            return ""
        now = self.offset()
        what = f"what {self._host} says is not passed on"
        if now.ahead_s is None or now.uncertainty_s is None:
            return f"its clock is not compared: {self.keeper} does not answer; {what}"
        limit_s = self._trust.limit_ns / NS
        text = (
            f"its clock is {apart(now.ahead_s, self.keeper)}, sure to {amount(now.uncertainty_s)}, and may be"
            f" {amount(limit_s)} off: {what}"
        )
        if abs(now.ahead_s) > limit_s:
            slewed_s = abs(now.ahead_s) / (SLEW_PPM * PPM)
            text += f"; it is right in {slewed_s / 60:.0f} min, or at once when this host's share is started anew"
        return text

    def offset(self) -> ClockOffset:
        """The comparison as it is now."""
        message = ClockOffset(host=self._host, keeper=self.keeper, state="waits", unanswered=self._unanswered)
        if self.keeper == self._host:
            message.state = "keeps"
            return message
        if (found := self._estimate()) is not None:
            message.ahead_s = (self._setting.offset_ns - found.ahead_ns) / NS
            message.uncertainty_s = found.uncertainty_ns / NS
            message.gains_ppm = -found.slope / PPM if found.slope_known else None
            message.round_trip_s = found.round_trip_ns / NS
            message.state = "follows" if self._corrects else "shown"
        if self.refused:
            message.state = "refused"
        return message

    async def _publish(self) -> None:
        while True:
            self._node.publish(OFFSET.of(self._node.name), self.offset())
            await asyncio.sleep(PUBLISH_EVERY_S)
