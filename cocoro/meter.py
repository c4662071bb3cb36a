"""What a process costs."""

from __future__ import annotations

import time

import psutil


class ProcessMeter:
    """CPU share since the last call, and resident memory, of this process."""

    def __init__(self) -> None:
        self._process = psutil.Process()
        self._cpu_s = self._used_s()
        self._at_s = time.monotonic()

    def _used_s(self) -> float:
        times = self._process.cpu_times()
        return times.user + times.system

    def take(self) -> tuple[float, float]:
        """(share of one core since the last call, resident MB)."""
        cpu_s, at_s = self._used_s(), time.monotonic()
        share = (cpu_s - self._cpu_s) / max(at_s - self._at_s, 1e-6)
        self._cpu_s, self._at_s = cpu_s, at_s
        return share, self._process.memory_info().rss / 1e6
