"""What a process costs."""

from __future__ import annotations

import logging
import resource
import sys
import time

import psutil

log = logging.getLogger(__name__)


class ProcessMeter:
    """CPU share since the last call, and resident memory, of this process."""

    def __init__(self) -> None:
        self._cpu_s, self._at_s = time.process_time(), time.monotonic()
        self._process: psutil.Process | None = None
        try:
            self._process = psutil.Process()
            self._process.memory_info()
        except (psutil.Error, OSError) as error:
            log.warning("/proc cannot be read (%s): its largest memory ever is told for that of now", error)
            self._process = None

    def take(self) -> tuple[float, float]:
        """(share of one core since the last call, resident MB); the most MB ever where /proc does not tell it."""
        cpu_s, at_s = time.process_time(), time.monotonic()
        share = (cpu_s - self._cpu_s) / max(at_s - self._at_s, 1e-6)
        self._cpu_s, self._at_s = cpu_s, at_s
        return share, self._rss_mb()

    def _rss_mb(self) -> float:
        if self._process is not None:
            return float(self._process.memory_info().rss) / 1e6
        unit = 1 if sys.platform == "darwin" else 1024  # getrusage(2)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
