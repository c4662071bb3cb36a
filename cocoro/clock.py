"""Clocks: real, virtual (the event loop's own time), and followed (the simulator's clock key).

A clock that jumps back starts a new epoch; whoever keeps ages, histories or deadlines begins anew then.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Protocol

NS = 1_000_000_000
CLOCKS_APART_NS = NS // 4
"""A stamp may be this far ahead of our clock: two machines' clocks are never quite the same."""


def is_fresh(stamp_ns: int, now_ns: int, max_age_s: float) -> bool:
    """Whether what was stamped then may be acted on now. What lies ahead of our clock is of another epoch: what was
    heard before a clock jumped back says nothing of now."""
    return -CLOCKS_APART_NS <= now_ns - stamp_ns <= max_age_s * NS


class Clock(Protocol):
    @property
    def epoch(self) -> int:
        """Counts the times that the clock jumped back."""

    @property
    def stands(self) -> bool:
        """Time does not go on: whatever keeps it has stopped, or died."""

    def now_ns(self) -> int: ...

    async def sleep_until(self, when_ns: int) -> bool:
        """Wait for a time. False when a new epoch began instead: the deadline has lost its meaning.
        Others get their turn even when the time has passed already."""


async def sleep(clock: Clock, seconds: float) -> bool:
    """Wait for a duration of the clock's time; False when a new epoch began meanwhile."""
    return await clock.sleep_until(clock.now_ns() + round(seconds * NS))


class RealClock:
    """The system's clock. Waiting is paced by the monotonic clock, in slices so that a step is noticed."""

    STEP_NS = NS // 2
    """A jump back by more than this is a new epoch (a smaller one is the time daemon's work)."""

    def __init__(self) -> None:
        self._newest_ns = 0
        self._epoch = 0

    stands = False

    @property
    def epoch(self) -> int:
        self.now_ns()
        return self._epoch

    def now_ns(self) -> int:
        now = time.time_ns()
        if now < self._newest_ns:
            if self._newest_ns - now <= self.STEP_NS:
                return self._newest_ns
            self._epoch += 1
        self._newest_ns = now
        return now

    async def sleep_until(self, when_ns: int) -> bool:
        epoch = self.epoch
        await asyncio.sleep(0)
        while (left_ns := when_ns - self.now_ns()) > 0:
            if self._epoch != epoch:
                return False
            await asyncio.sleep(min(left_ns / NS, 1.0))
        return self._epoch == epoch


class VirtualClock:
    """The running event loop's own time, for `vloop.VirtualTimeLoop`."""

    epoch = 0
    stands = False

    def now_ns(self) -> int:
        return round(asyncio.get_running_loop().time() * NS)

    async def sleep_until(self, when_ns: int) -> bool:
        loop = asyncio.get_running_loop()
        if when_ns > self.now_ns():
            done = loop.create_future()
            timer = loop.call_at(when_ns / NS, _finish, done)
            try:
                await done
            finally:
                timer.cancel()
        else:
            await asyncio.sleep(0)
        return True


def _finish(done: asyncio.Future[None]) -> None:
    if not done.done():
        done.set_result(None)


class FollowedClock:
    """Follows ticks of simulated time. Between ticks it runs on at the simulator's rate, for at most
    `run_on_s`: when the simulator stands still, time stands still."""

    STANDS_NS = NS
    """Without a tick for so long of real time, the clock stands: the slowest simulator ticks oftener."""

    def __init__(self, run_on_s: float = 0.03) -> None:
        self.driven = False
        """Somebody in this process ticks it: see `Node.drive_clock`."""
        self._run_on_ns = round(run_on_s * NS)
        self._epoch = 0
        self._incarnation: int | None = None
        self._tick_ns = 0
        self._tick_real_ns = 0
        self._newest_ns = 0
        self._rate = 1.0
        self._sleeping: dict[asyncio.Future[None], int] = {}
        """Until when each wants to sleep. A tick wakes only those to whom it matters: there are a hundred a second."""

    @property
    def epoch(self) -> int:
        return self._epoch

    @property
    def started(self) -> bool:
        return self._incarnation is not None

    @property
    def stands(self) -> bool:
        return time.monotonic_ns() - self._tick_real_ns > self.STANDS_NS

    def tick(self, stamp_ns: int, incarnation: int, rate: float = 1.0) -> None:
        """A sample of the clock key. Ticks that arrive late within an incarnation are ignored."""
        anew = incarnation != self._incarnation
        if anew:
            if self._incarnation is not None:
                self._epoch += 1
            self._incarnation = incarnation
            self._newest_ns = 0
        elif stamp_ns < self._tick_ns:
            return
        self._tick_ns = stamp_ns
        self._tick_real_ns = time.monotonic_ns()
        self._rate = min(max(rate, 0.01), 2.0)
        reachable_ns = stamp_ns + self._run_on_ns
        for sleeper, when_ns in self._sleeping.items():
            if (anew or when_ns <= reachable_ns) and not sleeper.done():
                sleeper.set_result(None)

    def now_ns(self) -> int:
        if self._incarnation is None:
            return 0
        run_on = min(round((time.monotonic_ns() - self._tick_real_ns) * self._rate), self._run_on_ns)
        self._newest_ns = max(self._newest_ns, self._tick_ns + run_on)
        return self._newest_ns

    async def wait_started(self) -> None:
        while self._incarnation is None:
            await self._tick_that_reaches(0)

    async def sleep_until(self, when_ns: int) -> bool:
        await self.wait_started()
        epoch = self._epoch
        await asyncio.sleep(0)
        while (left_ns := when_ns - self.now_ns()) > 0 and self._epoch == epoch:
            reachable_ns = self._tick_ns + self._run_on_ns - self.now_ns()
            # A tick may say that time goes faster than it seemed, so it always ends the wait.
            wait_s = left_ns / NS / self._rate if left_ns <= reachable_ns else None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._tick_that_reaches(when_ns)
        return self._epoch == epoch

    async def _tick_that_reaches(self, when_ns: int) -> None:
        """From which on the clock may run to this time by itself; or one of another epoch."""
        sleeper: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._sleeping[sleeper] = when_ns
        try:
            await sleeper
        finally:
            del self._sleeping[sleeper]
