"""Heartbeats: by them the supervisor notices a process that hangs as surely as one that died.

A process that was stopped, blocks or loops for ever keeps its claim, and as long as the mesh's threads run also its
liveliness tokens. So its event loop moves a counter in memory that the supervisor shares, and the supervisor kills a
process whose counter stands. Only time in which the process could run counts, so that no starved machine kills anybody.
"""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import NamedTuple

from cocoro.errors import ConfigError

BEAT_S = 0.5
LOOK_S = 1.0
"""Period at which the supervisor looks at the counters."""
LATE_S = 2.0
"""A look that is later than this counts for nothing: the supervisor itself was asleep, and perhaps all others, too."""
HANGS_S = 10.0
"""A process whose event loop has not run for so long, though it could, hangs."""
STOPPED_S = 2.5
"""The same for a process that a signal has stopped: it does not go on by itself, so there is nothing to wait for."""
GRACE = "COCORO_DEBUG_GRACE_S"
"""Environment variable of the supervisor that replaces both times, for debuggers; 0: nobody is killed for hanging."""
_BYTES = 8


class Grace(NamedTuple):
    """Times after which a process hangs, s; 0 for never."""

    hangs_s: float = HANGS_S
    stopped_s: float = STOPPED_S


def grace() -> Grace:
    """The times that hold here. Raises ConfigError for a variable that is no time."""
    text = os.environ.get(GRACE, "").strip()
    if not text:
        return Grace()
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < float("inf"):
        raise ConfigError(f"{GRACE} is {text!r}: a number of seconds is expected, 0 for no limit")
    return Grace(seconds, seconds)


async def beat(fd: int) -> None:
    """Move the counter in the file `fd` for as long as this event loop runs."""
    count = 0
    while True:
        count += 1
        os.pwrite(fd, count.to_bytes(_BYTES, "little"), 0)
        await asyncio.sleep(BEAT_S)


class Use(NamedTuple):
    """What /proc tells of a process's main thread."""

    state: str
    """A letter: R runs or waits for a processor, S sleeps, D waits for a device, T is stopped, t is traced."""
    ran_s: float
    waited_s: float
    """Time on a processor, and time in which it waited for one."""
    traced: bool


def use_of(pid: int) -> Use | None:
    """None when it cannot be read: the process has ended, or there is no /proc."""
    folder = Path(f"/proc/{pid}")
    try:
        status = (folder / "status").read_text()
        ran_ns, waited_ns = map(int, (folder / "schedstat").read_text().split()[:2])
    except (OSError, ValueError):
        return None
    lines = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
    traced = lines.get("TracerPid", "0").strip() != "0"
    return Use(lines.get("State", "?").strip()[:1], ran_ns / 1e9, waited_ns / 1e9, traced)


class Pulse:
    """The heartbeat of one process, as its supervisor feels it. `close` it with the process."""

    def __init__(self) -> None:
        self.fd = os.memfd_create("cocoro-heartbeat", os.MFD_CLOEXEC)
        self._count = b""
        self._before: Use | None = None
        self.still_s = 0.0
        """Time in which the event loop did not run, though the process could."""

    def close(self) -> None:
        os.close(self.fd)

    def hangs(self, grace: Grace) -> bool:
        """Whether the event loop has stood still for longer than the grace."""
        stopped = self._before is not None and self._before.state == "T"
        return self.still_s >= (grace.stopped_s if stopped else grace.hangs_s)

    def feel(self, pid: int, passed_s: float) -> None:
        """Look at the counter. `passed_s` is the time since the last look."""
        count = os.pread(self.fd, _BYTES, 0)
        use, before = use_of(pid), self._before
        self._before = use
        if count != self._count or not count or (use is not None and use.traced):
            self._count, self.still_s = count, 0.0
        elif passed_s <= LATE_S:
            self.still_s += passed_s if use is None or before is None else _able_s(before, use, passed_s)


def _able_s(before: Use, use: Use, passed_s: float) -> float:
    """Time between two looks in which a process could have run its event loop."""
    if use.state == "R":  # the time for which it waits for a processor is known only when it gets one
        return min(max(use.ran_s - before.ran_s, 0.0), passed_s)
    if use.state == "D":  # no signal ends it now
        return 0.0
    return max(passed_s - max(use.waited_s - before.waited_s, 0.0), 0.0)
