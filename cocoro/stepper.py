"""Loops at a fixed rate, and the loop that steps a pure core."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any, Protocol, TypeVar

from cocoro.clock import NS, Clock
from cocoro.core import Core, Output, Sample, Schedule
from cocoro.health import LoopMeter
from cocoro.inbox import Inbox
from cocoro.messages import Message, StepRecord
from cocoro.topics import STEPS, Topic

M = TypeVar("M", bound=Message)


class Deadlines:
    """Deadlines at a fixed rate, from the construction on. A late loop skips whole periods and keeps its phase; a new
    epoch of the clock and `restart` begin a new phase. Raises ValueError for a rate that is not positive."""

    def __init__(self, clock: Clock, rate_hz: float, meter: LoopMeter) -> None:
        if rate_hz <= 0:
            raise ValueError(f"rate_hz must be positive, not {rate_hz}")
        self._clock = clock
        self._period_ns = round(NS / rate_hz)
        self._meter = meter
        self._epoch = clock.epoch
        self.next_ns = clock.now_ns()

    def advance(self) -> int:
        """Returns the next deadline, ns; call it after the work of the present one."""
        now_ns = self._clock.now_ns()
        if self._clock.epoch != self._epoch:
            self._epoch = self._clock.epoch
            self.next_ns = now_ns
        self.next_ns += self._period_ns
        missed = max(0, (now_ns - self.next_ns) // self._period_ns)
        if missed:
            self._meter.overruns += missed
            self.next_ns += missed * self._period_ns
        return self.next_ns

    def restart(self, now_ns: int) -> None:
        """The next deadline is a period after `now_ns`, when work began before its deadline."""
        self.next_ns = now_ns + self._period_ns


async def every(clock: Clock, rate_hz: float, meter: LoopMeter) -> AsyncIterator[int]:
    """Yields the clock's time, ns, at a fixed rate; the first time as soon as the clock has started."""
    deadlines: Deadlines | None = None
    while True:
        await clock.sleep_until(deadlines.next_ns if deadlines is not None else 0)
        if deadlines is None:  # not before: a followed clock starts at any time
            deadlines = Deadlines(clock, rate_hz, meter)
        now_ns = clock.now_ns()
        meter.began(now_ns)
        yield now_ns
        deadlines.advance()


class Intake:
    """Collects what arrives between two steps of a core, in order of arrival; of a `latest` topic only the newest."""

    def __init__(self, limit: int = 4096) -> None:
        self._limit = limit
        self._samples: dict[int, tuple[Topic[Any], Message]] = {}
        self._next = 0
        self._last_of: dict[str, int] = {}

    def reader(
        self, topic: Topic[M], inbox: Inbox[M], take_all: bool, wake: Callable[[], None] | None
    ) -> Callable[[str, M], None]:
        def take(_key: str, message: M) -> None:
            if not take_all:
                older = self._last_of.get(topic.name)
                if older is not None and self._samples.pop(older, None) is not None and wake is not None:
                    inbox.unread += 1  # the core was too slow; others' newest message alone is wanted
                self._last_of[topic.name] = self._next
            elif len(self._samples) >= self._limit:
                del self._samples[next(iter(self._samples))]
                inbox.unread += 1
            self._samples[self._next] = (topic, message)
            self._next += 1
            if wake is not None:
                wake()

        return take

    def take(self) -> list[tuple[Topic[Any], Message]]:
        samples = list(self._samples.values())
        self._samples.clear()
        self._last_of.clear()
        return samples


class Host(Protocol):
    """The part of a node that a stepper needs."""

    @property
    def name(self) -> str: ...

    @property
    def record_steps(self) -> bool: ...

    def inbox(self, topic: Topic[M]) -> Inbox[M]: ...

    def publish(self, topic: Topic[M], message: M) -> M: ...


class Wake(asyncio.Event):
    """An event that one task can await until a deadline, too."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: asyncio.Future[None] | None = None
        """Of `until`."""

    def set(self) -> None:
        super().set()
        if self._waiting is not None:
            _after_others(asyncio.get_running_loop(), self._waiting)

    async def until(self, deadline_s: float) -> bool:
        """Wait for a deadline of the event loop's time (True) or to be set before (False). What is sent at the same
        time is received before."""
        loop = asyncio.get_running_loop()
        self._waiting = waiting = loop.create_future()
        timer = loop.call_at(deadline_s, _after_others, loop, waiting)
        if self.is_set():
            _after_others(loop, waiting)
        try:
            await waiting
        finally:
            self._waiting = None
            timer.cancel()
        return loop.time() >= deadline_s


def _after_others(loop: asyncio.AbstractEventLoop, waiting: asyncio.Future[None]) -> None:
    """Finish a future, and so give its task its turn, after what is sent in this turn of the loop was received."""
    loop.call_soon(loop.call_soon, _finish, waiting)


def _finish(waiting: asyncio.Future[None]) -> None:
    if not waiting.done():
        waiting.set_result(None)


class Stepper:
    """Collects a core's inputs; each call is one step: take the inputs, compute, publish, record."""

    def __init__(self, host: Host, core: Core, name: str) -> None:
        self.wake = Wake()
        """Set when a triggering topic arrives."""
        self._host = host
        self._core = core
        self._name = name
        self._intake = Intake()
        triggers = {topic.name for topic in core.schedule.triggers}
        for topic, take in core.reads.items():
            inbox = host.inbox(topic)
            wake = self.wake.set if topic.name in triggers else None
            inbox.add(self._intake.reader(topic, inbox, take == "all", wake))

    async def __call__(self, now_ns: int) -> int:
        """One step. Returns the number of messages that it published."""
        samples, outputs = self.compute(now_ns)
        return self.publish(now_ns, samples, outputs, now_ns)

    def compute(self, now_ns: int) -> tuple[list[Sample], Sequence[Output]]:
        """Steps the core with what has arrived. Returns what it consumed and its outputs."""
        samples = [Sample(topic, message) for topic, message in self._intake.take()]
        return samples, self._core.step(samples, now_ns)

    def publish(self, now_ns: int, samples: Sequence[Sample], outputs: Sequence[Output], stamp_ns: int) -> int:
        """Publishes a step's outputs, stamped with `stamp_ns` unless they have a stamp, and its record when steps are
        recorded. Returns the number of outputs."""
        host = self._host
        produced = []
        for topic, message in outputs:
            if message.stamp_ns == 0:
                message.stamp_ns = stamp_ns
            sent = host.publish(topic, message)
            produced.append((topic.name, sent.incarnation, sent.seq))
        if host.record_steps:
            consumed = tuple((s.topic.name, s.message.incarnation, s.message.seq) for s in samples)
            record = StepRecord(now_ns=now_ns, core=self._name, consumed=consumed, produced=tuple(produced))
            host.publish(STEPS.of(host.name), record)
        return len(produced)


async def drive(step: Stepper, schedule: Schedule, clock: Clock, meter: LoopMeter) -> None:
    """Steps for ever, at the times of a core's schedule."""
    deadlines = Deadlines(clock, schedule.rate_hz, meter) if schedule.rate_hz else None
    epoch = clock.epoch
    while True:
        if deadlines is None:
            await step.wake.wait()
            due = True
        else:
            # The clock may have jumped back during a step: then the deadline is of an earlier epoch.
            due = clock.epoch != epoch or await _wait(clock, step.wake, deadlines.next_ns)
        if clock.epoch != epoch:
            epoch = clock.epoch
            due = True
        step.wake.clear()
        now_ns = clock.now_ns()
        meter.began(now_ns)
        started = time.perf_counter()
        await step(now_ns)
        meter.steps_ms.append((time.perf_counter() - started) * 1e3)
        if deadlines is not None and due:
            deadlines.advance()
        elif deadlines is not None:
            deadlines.restart(now_ns)


async def _wait(clock: Clock, wake: Wake, deadline_ns: int) -> bool:
    """Waits for a deadline (True) or an earlier wake (False)."""
    if clock.now_ns() >= deadline_ns:
        await asyncio.sleep(0)  # a core that is too slow for its rate must leave other tasks their turn
        return True
    if clock.of_loop:  # without the tasks that another clock needs
        return await wake.until(deadline_ns / NS)
    timer = asyncio.ensure_future(clock.sleep_until(deadline_ns))
    waker = asyncio.ensure_future(wake.wait())
    try:
        await asyncio.wait((timer, waker), return_when=asyncio.FIRST_COMPLETED)
        return timer.done()
    finally:
        timer.cancel()
        waker.cancel()
