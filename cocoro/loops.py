"""Fixed-rate loops that say how well they keep their rate."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncIterator

import numpy as np

from cocoro.clock import NS, Clock
from cocoro.messages import LoopHealth


class LoopMeter:
    """Periods, step times and overruns of one loop; `health` tells of the time since its last call."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.overruns = 0
        self.periods_ms: deque[float] = deque(maxlen=4096)
        self.steps_ms: deque[float] = deque(maxlen=4096)
        self._last_ns: int | None = None

    def began(self, now_ns: int) -> None:
        if self._last_ns is not None and now_ns >= self._last_ns:
            self.periods_ms.append((now_ns - self._last_ns) / 1e6)
        self._last_ns = now_ns

    def health(self) -> LoopHealth:
        periods, steps = np.array(self.periods_ms), np.array(self.steps_ms)
        self.periods_ms.clear()
        self.steps_ms.clear()
        median = float(np.median(periods)) if periods.size else 0.0
        return LoopHealth(
            name=self.name,
            rate_hz=1e3 / float(periods.mean()) if periods.size and periods.mean() > 0 else 0.0,
            period_median_ms=median,
            period_p99_ms=float(np.percentile(periods, 99)) if periods.size else 0.0,
            step_median_ms=float(np.median(steps)) if steps.size else 0.0,
            overruns=self.overruns,
        )


class Schedule:
    """Deadlines at a fixed rate from the first call on. Late loops skip whole periods and keep their phase; a new
    epoch of the clock starts the schedule anew."""

    def __init__(self, clock: Clock, rate_hz: float, meter: LoopMeter) -> None:
        if rate_hz <= 0:
            raise ValueError(f"rate_hz must be positive, not {rate_hz}")
        self._clock = clock
        self._period_ns = round(NS / rate_hz)
        self._meter = meter
        self._epoch = clock.epoch
        self.deadline_ns = clock.now_ns()

    def advance(self) -> int:
        """The next deadline; call it after the work of the present one."""
        now_ns = self._clock.now_ns()
        if self._clock.epoch != self._epoch:
            self._epoch = self._clock.epoch
            self.deadline_ns = now_ns
        self.deadline_ns += self._period_ns
        missed = max(0, (now_ns - self.deadline_ns) // self._period_ns)
        if missed:
            self._meter.overruns += missed
            self.deadline_ns += missed * self._period_ns
        return self.deadline_ns


async def every(clock: Clock, rate_hz: float, meter: LoopMeter) -> AsyncIterator[int]:
    """Yields the clock's time at a fixed rate; the first time at once, or when the clock starts."""
    schedule: Schedule | None = None
    while True:
        await clock.sleep_until(schedule.deadline_ns if schedule is not None else 0)
        if schedule is None:  # only now: a followed clock that was not heard before starts anywhere
            schedule = Schedule(clock, rate_hz, meter)
        now_ns = clock.now_ns()
        meter.began(now_ns)
        yield now_ns
        schedule.advance()
