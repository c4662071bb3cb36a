"""Time that nobody sets: nanoseconds since this machine was booted, the time that it slept among them.

CLOCK_BOOTTIME, and not CLOCK_MONOTONIC, which stands while the machine sleeps: after a sleep, differences of it are as
long as the wall says. The time daemon's slow corrections move both clocks and the wall clock alike, so the wall clock
minus this one changes only when somebody sets the wall clock.
"""

from __future__ import annotations

import time
from functools import partial

boottime_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
"""Nanoseconds since the boot, those of sleep among them. Takes no argument; costs as much as `time.time_ns`."""
