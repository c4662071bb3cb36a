"""Clocks: real, virtual (the event loop's own time), and followed (the ticks of the simulator's clock key).

Nothing that decides reads the wall clock: it can be set, and then ages and deadlines would be wrong. The real clock
counts the time since the machine was started, the followed clock the simulator's ticks. A followed clock can jump back
(the simulator was restarted, a replay went back): that begins a new epoch, in which ages, histories and deadlines begin
anew. The real clock has one epoch, but where a site's gateway sets it back before the robot's processes have started.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from array import array
from collections.abc import Sequence
from math import exp
from typing import NamedTuple, Protocol

NS = 1_000_000_000
CLOCKS_APART_NS = NS // 4
"""Greatest difference between the clocks of two machines of one robot. `cocoro.inbox` rejects a stamp that is further
ahead of the reader's clock."""


def steady_ns() -> int:
    """Nanoseconds since this machine was started, on the one clock that nobody can set (CLOCK_BOOTTIME).

    It counts the time during which the machine was suspended, which CLOCK_MONOTONIC does not: a command from before a
    suspension must not seem fresh after it.
    """
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def wall_offset_ns() -> int:
    """Wall time minus `steady_ns`, now: the only place where the wall clock is read."""
    before_ns, wall_ns, after_ns = steady_ns(), time.time_ns(), steady_ns()
    return wall_ns - (before_ns + after_ns) // 2


def is_fresh(stamp_ns: int, now_ns: int, max_age_s: float) -> bool:
    """Whether a message with this stamp may be acted on now. A stamp that is further ahead than CLOCKS_APART_NS is of
    another epoch: the message was received before the clock jumped back."""
    return -CLOCKS_APART_NS <= now_ns - stamp_ns <= max_age_s * NS


class Clock(Protocol):
    @property
    def virtual(self) -> bool:
        """Whether time goes on with the event loop's own, so that every run is the same."""

    @property
    def of_loop(self) -> bool:
        """Whether times are those of the event loop: it never jumps, and a deadline is one of the loop's timers."""

    @property
    def epoch(self) -> int:
        """Number of times that the clock has jumped back."""

    @property
    def stands(self) -> bool:
        """Whether time does not go on, because its source has stopped or died."""

    @property
    def needs_ticks(self) -> bool:
        """Whether the clock has to be ticked by messages of the clock key (`Node` does it)."""

    def now_ns(self) -> int: ...

    def latest_ns(self) -> int | None:
        """Upper bound of the present time: ticks may be on their way. None before the clock has started."""

    def drive(self) -> None:
        """Announces that the caller will call `tick` itself."""

    def tick(self, stamp_ns: int, incarnation: int, rate: float = 1.0) -> str:
        """Takes a sample of the clock key; returns why it is rejected, or ''. A clock with an own source ignores it."""

    async def wait_started(self) -> None:
        """Returns when the clock has a time."""

    async def sleep_until(self, when_ns: int) -> bool:
        """Waits for a time. False when a new epoch began instead: the deadline has lost its meaning. Yields to other
        tasks even when the time has passed already."""


async def sleep(clock: Clock, seconds: float) -> bool:
    """Waits for a duration of the clock's time; False when a new epoch began meanwhile."""
    return await clock.sleep_until(clock.now_ns() + round(seconds * NS))


class _OwnTime:
    """Base of clocks whose time comes from this process."""

    epoch = 0
    stands = False
    needs_ticks = False

    def drive(self) -> None:
        pass

    def tick(self, stamp_ns: int, incarnation: int, rate: float = 1.0) -> str:
        return ""

    async def wait_started(self) -> None:
        pass


class RealClock(_OwnTime):
    """`steady_ns` plus an offset to wall time: the robot's clock when there is no simulator.

    So stamps read as wall time, and setting the wall clock later changes nothing. All processes of a robot on a machine
    use the same offset: see `deploy.robot_time`. Where several machines share a robot, it is slewed while they run, so
    that their clocks agree: see `deploy.site.timekeeping`.
    """

    virtual = False
    of_loop = False
    SLICE_S = 1.0
    """Waits are cut into slices of this length: this clock counts a suspension, the event loop's timers do not."""
    HELD_NS = NS // 1000
    """When the offset is slewed back, by less than this, time stands until it has caught up, and does not go back. By
    more than this it is set only before a robot's processes have started; that begins a new epoch."""

    def __init__(self, offset: int | Sequence[int] | None = None) -> None:
        """`offset`: wall time minus `steady_ns` in nanoseconds, or a cell whose first item that is, now and later;
        measured now by default."""
        if offset is None:
            offset = wall_offset_ns()
        self._cell: Sequence[int] = array("q", (offset,)) if isinstance(offset, int) else offset
        self.epoch = 0
        self._newest_ns = 0

    @property
    def offset_ns(self) -> int:
        return self._cell[0]

    def now_ns(self) -> int:
        # `steady_ns`, without the call: this is asked for each message.
        now_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) + self._cell[0]
        if now_ns < self._newest_ns:
            if self._newest_ns - now_ns < self.HELD_NS:
                return self._newest_ns
            self.epoch += 1
        self._newest_ns = now_ns
        return now_ns

    def latest_ns(self) -> int | None:
        return self.now_ns()

    async def sleep_until(self, when_ns: int) -> bool:
        epoch = self.epoch
        await asyncio.sleep(0)
        while (left_ns := when_ns - self.now_ns()) > 0 and self.epoch == epoch:  # noqa: ASYNC110 # time itself is waited for
            await asyncio.sleep(min(left_ns / NS, self.SLICE_S))
        return self.epoch == epoch


class VirtualClock(_OwnTime):
    """The running event loop's own time, for `vloop.VirtualTimeLoop`."""

    virtual = True
    of_loop = True

    def now_ns(self) -> int:
        return round(asyncio.get_running_loop().time() * NS)

    def latest_ns(self) -> int | None:
        return self.now_ns()

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


class Ticks(NamedTuple):
    """Successive rejected ticks, each consistent with the one before."""

    length: int
    stamp_ns: int
    at_ns: int


class FollowedClock:
    """Follows ticks of simulated time. Between ticks it runs on at the simulator's rate, for at most `run_on_s`: when
    the simulator stands still, time stands still.

    A single wrong tick moves nothing. Wrong is a tick before the last one, or further ahead than `LEAP_NS` plus twice
    what the last tick's rate gives in the real time that has passed, plus what ticks before it came too late for: a
    process that did not run receives them in a burst. After `FOLLOWED_AFTER` wrong ticks in a row
    that agree with one another, the clock follows them. Ahead, that is only later (a replay was moved forward). Back
    by more than CLOCKS_APART_NS, it is a new epoch: the tick before them was the wrong one. Back by less than that,
    the clock waits until the ticks have caught up.
    """

    virtual = False
    of_loop = False
    STANDS_NS = NS
    """Without a tick for this much real time the clock stands: the slowest simulator ticks more often."""
    LEAP_NS = NS // 10
    """A wrong tick that is ahead by less than this is taken; time then stands until the others have caught up."""
    BEHIND_NS = NS // 2
    """Ticks' delay is forgotten with this time constant: a simulator that did not get its time never makes it up."""
    FOLLOWED_AFTER = 3
    FASTEST = 100.0
    """Highest rate of a replay, simulated seconds per real second."""

    def __init__(self, run_on_s: float = 0.03) -> None:
        self.needs_ticks = True
        self._run_on_ns = round(run_on_s * NS)
        self._epoch = 0
        self._incarnation: int | None = None
        self._tick_ns = 0
        self._tick_real_ns = 0
        self._newest_ns = 0
        self._behind_ns = 0.0
        self._rate = 1.0
        self._pace = 1.0
        self._doubted: Ticks | None = None
        self._sleeping: dict[asyncio.Future[None], int] = {}
        """Wake-up time of each sleeper. Of a hundred ticks a second each wakes only those that it concerns."""

    @property
    def epoch(self) -> int:
        return self._epoch

    @property
    def started(self) -> bool:
        return self._incarnation is not None

    @property
    def stands(self) -> bool:
        return steady_ns() - self._tick_real_ns > self.STANDS_NS

    def drive(self) -> None:
        self.needs_ticks = False

    def tick(self, stamp_ns: int, incarnation: int, rate: float = 1.0) -> str:
        real_ns = steady_ns()
        anew = incarnation != self._incarnation
        if not anew:
            ahead_ns, passed_ns = stamp_ns - self._tick_ns, real_ns - self._tick_real_ns
            if not 0 <= ahead_ns <= self._credible_ns(passed_ns) + self._behind_ns:
                if not self._insists(stamp_ns, real_ns):
                    return _rejection(ahead_ns, passed_ns)
                anew = ahead_ns < 0
            kept = exp(-passed_ns / self.BEHIND_NS)
            self._behind_ns = max(self._behind_ns * kept + self._pace * passed_ns - ahead_ns, 0.0)
        if anew:
            if self._incarnation is not None:
                self._epoch += 1
            self._incarnation = incarnation
            self._newest_ns = 0
            self._behind_ns = 0.0
        self._doubted = None
        self._tick_ns = stamp_ns
        self._tick_real_ns = real_ns
        self._rate = min(max(rate, 0.01), 2.0)
        self._pace = min(max(rate, 1.0), self.FASTEST)
        reachable_ns = stamp_ns + self._run_on_ns
        for sleeper, when_ns in self._sleeping.items():
            if (anew or when_ns <= reachable_ns) and not sleeper.done():
                sleeper.set_result(None)
        return ""

    def _credible_ns(self, passed_ns: int) -> int:
        """How far ticks can have advanced in some real time."""
        return self.LEAP_NS + round(2 * self._pace * passed_ns)

    def _insists(self, stamp_ns: int, real_ns: int) -> bool:
        """Whether a rejected tick is the `FOLLOWED_AFTER`th in a row that agree, so that the clock follows it."""
        if 0 < self._tick_ns - stamp_ns <= CLOCKS_APART_NS:
            return False
        length, before = 1, self._doubted
        if before is not None and 0 < stamp_ns - before.stamp_ns <= self._credible_ns(real_ns - before.at_ns):
            length = before.length + 1
        self._doubted = Ticks(length, stamp_ns, real_ns)
        return length >= self.FOLLOWED_AFTER

    def now_ns(self) -> int:
        if self._incarnation is None:
            return 0
        run_on = min(round((steady_ns() - self._tick_real_ns) * self._rate), self._run_on_ns)
        self._newest_ns = max(self._newest_ns, self._tick_ns + run_on)
        return self._newest_ns

    def latest_ns(self) -> int | None:
        if self._incarnation is None:
            return None
        return self._tick_ns + self._credible_ns(steady_ns() - self._tick_real_ns) - self.LEAP_NS

    async def wait_started(self) -> None:
        while self._incarnation is None:
            await self._tick_that_reaches(0)

    async def sleep_until(self, when_ns: int) -> bool:
        await self.wait_started()
        epoch = self._epoch
        await asyncio.sleep(0)
        while (left_ns := when_ns - self.now_ns()) > 0 and self._epoch == epoch:
            reachable_ns = self._tick_ns + self._run_on_ns - self.now_ns()
            # Without a limit where only another tick can bring the time; a tick may also change the rate.
            wait_s = left_ns / NS / self._rate if left_ns <= reachable_ns else None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._tick_that_reaches(when_ns)
        return self._epoch == epoch

    async def _tick_that_reaches(self, when_ns: int) -> None:
        """Waits for a tick after which the clock can run on to `when_ns` by itself, or for one of a new epoch."""
        sleeper: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._sleeping[sleeper] = when_ns
        try:
            await sleeper
        finally:
            del self._sleeping[sleeper]


def _rejection(ahead_ns: int, passed_ns: int) -> str:
    if ahead_ns < 0:
        return f"a tick {-ahead_ns / NS:.3f} s before the last one"
    return f"a tick {ahead_ns / NS:.3f} s ahead, {passed_ns / NS:.3f} s after the last one"
