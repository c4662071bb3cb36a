"""What steps a pure core for its node, and the loop that does so at the core's rate."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from cocoro.clock import NS, Clock, FollowedClock
from cocoro.core import Core, Sample
from cocoro.inbox import Intake
from cocoro.loops import Schedule
from cocoro.messages import StepRecord
from cocoro.tokens import recorder_key
from cocoro.topics import STEPS

if TYPE_CHECKING:
    from cocoro.node import Node

RECORDER_S = 5.0
"""How long a service whose steps are to be recorded waits for a recorder before its first."""


class Stepper:
    """Gathers a core's inputs; each call is one step: take, step, wait out the latency, publish, record."""

    def __init__(self, node: Node, core: Core, name: str) -> None:
        self.wake = asyncio.Event()
        self._node = node
        self._core = core
        self._name = name
        self._intake = Intake()
        triggers = {topic.name for topic in core.schedule.triggers}
        for topic, take in core.reads.items():
            inbox = node.inbox(topic)
            wake = self.wake.set if topic.name in triggers else None
            inbox.add(self._intake.reader(topic, inbox, take == "all", wake))

    async def __call__(self, now_ns: int) -> int:
        """One step; the number of messages that it gave."""
        node = self._node
        samples = [Sample(topic, message) for topic, message in self._intake.take()]
        outputs = self._core.step(samples, now_ns)
        stamp_ns = now_ns
        if outputs and node.latency_s > 0:
            if not await node.sleep(node.latency_s):
                outputs = ()  # the clock began anew meanwhile: what was computed is of no time that there is
            # What takes longer to compute is said later; a command's age counts from when it could be given.
            stamp_ns += round(node.latency_s * NS)
        produced = []
        for topic, message in outputs:
            if message.stamp_ns == 0:
                message.stamp_ns = stamp_ns
            sent = node.publish(topic, message)
            produced.append((topic.name, sent.incarnation, sent.seq))
        if node.record_steps:
            consumed = tuple((s.topic.name, s.message.incarnation, s.message.seq) for s in samples)
            record = StepRecord(now_ns=now_ns, core=self._name, consumed=consumed, produced=tuple(produced))
            node.publish(STEPS.of(node.name), record)
        return len(produced)


async def drive(node: Node, core: Core, name: str) -> None:
    """Step a core for ever: at its rate, and at once when a triggering topic arrives."""
    if node.record_steps:
        await _until_recorded(node)
    step = node.stepper(core, name)
    meter = node.meter(name)
    clock = node.clock
    node.ready()  # whoever keeps the clock may come later: a replay, a simulator that starts anew
    if isinstance(clock, FollowedClock):
        await clock.wait_started()
    schedule = Schedule(clock, core.schedule.rate_hz, meter) if core.schedule.rate_hz else None
    epoch = clock.epoch
    while True:
        if schedule is None:
            await step.wake.wait()
            due = True
        else:
            # The clock may have begun anew in the middle of a step: the deadline is of the time before then.
            due = clock.epoch != epoch or await _wait(clock, step.wake, schedule.deadline_ns)
        if clock.epoch != epoch:
            epoch = clock.epoch
            due = True
        step.wake.clear()
        now_ns = clock.now_ns()
        if due:
            meter.began(now_ns)
        started = time.perf_counter()
        await step(now_ns)
        meter.steps_ms.append((time.perf_counter() - started) * 1e3)
        if due and schedule is not None:
            schedule.advance()


async def _until_recorded(node: Node) -> None:
    """A record of steps is whole only when a recorder hears the first; wait for one, but not for ever."""
    heard = asyncio.Event()

    def on_token(_key: str, alive: bool) -> None:
        if alive:
            heard.set()

    watch = node.bus.watch_alive(recorder_key(node.robot_name, "*"), on_token)
    try:
        async with asyncio.timeout(RECORDER_S):
            await heard.wait()
    except TimeoutError:
        node.log.warning("steps are to be recorded, but within %g s there was no recorder", RECORDER_S)
    finally:
        watch.close()


async def _wait(clock: Clock, wake: asyncio.Event, deadline_ns: int) -> bool:
    """Wait for a deadline (True) or an earlier wake (False)."""
    if clock.now_ns() >= deadline_ns:
        await asyncio.sleep(0)  # a core that is too slow for its rate must not keep everything else from running
        return True
    timer = asyncio.ensure_future(clock.sleep_until(deadline_ns))
    waker = asyncio.ensure_future(wake.wait())
    try:
        await asyncio.wait((timer, waker), return_when=asyncio.FIRST_COMPLETED)
        return timer.done()
    finally:
        timer.cancel()
        waker.cancel()
