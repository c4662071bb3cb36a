"""Notifications to systemd, when it started the supervisor: sd_notify(3) and the watchdog."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable
from contextlib import suppress

PETS = 3
"""Notifications per period of the watchdog, so that a late or missing one does no harm."""


def notify(state: str) -> None:
    """Send a line such as 'READY=1' to systemd, if that started this process."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.sendto(state.encode(), f"\0{address[1:]}" if address[0] == "@" else address)


def watchdog_s() -> float | None:
    """Period of this process's watchdog (`WatchdogSec` of the unit); None without a watchdog."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None  # the watchdog is for another process
    with suppress(ValueError):
        period_s = int(os.environ.get("WATCHDOG_USEC", "0")) / 1e6
        return period_s if period_s > 0 else None
    return None


async def keep_watchdog(works: Callable[[], bool]) -> None:
    """Notify the watchdog periodically while `works()` is true. Returns only when there is no watchdog."""
    period_s = watchdog_s()
    while period_s is not None:
        if works():
            notify("WATCHDOG=1")
        await asyncio.sleep(period_s / PETS)
