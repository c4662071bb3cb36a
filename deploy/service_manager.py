"""What a supervisor tells systemd, where that started it: sd_notify(3) and its watchdog."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable
from contextlib import suppress

PETS = 3
"""In each of the watchdog's periods: one that comes late, or is left out, is not yet too few."""


def notify(state: str) -> None:
    """Send a line such as 'READY=1'; nothing where there is no systemd."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.sendto(state.encode(), f"\0{address[1:]}" if address[0] == "@" else address)


def watchdog_s() -> float | None:
    """The period of this process's watchdog (`WatchdogSec` of the unit); None when nobody watches."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None  # it is meant for another
    with suppress(ValueError):
        period_s = int(os.environ.get("WATCHDOG_USEC", "0")) / 1e6
        return period_s if period_s > 0 else None
    return None


async def keep_watchdog(well: Callable[[], bool]) -> None:
    """Tell the watchdog again and again that all is well, for as long as `well` says so. Returns at once when nobody
    watches, and never otherwise."""
    period_s = watchdog_s()
    while period_s is not None:
        if well():
            notify("WATCHDOG=1")
        await asyncio.sleep(period_s / PETS)
