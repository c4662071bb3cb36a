"""Ctrl-C and its kin for commands that run until they are interrupted, which is then a normal end."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, `kill`, and the closing of the terminal."""


@contextmanager
def on_interrupt(handler: Callable[[], None]) -> Iterator[None]:
    """Calls `handler` at each of SIGNALS while the context lasts.

    A signal that the process ignores stays ignored (nohup, and scripts in the background), except SIGTERM.
    """
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in SIGNALS}
    numbers = [number for number in SIGNALS if before[number] != signal.SIG_IGN or number == signal.SIGTERM]
    for number in numbers:
        loop.add_signal_handler(number, handler)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])  # the loop restores Python's default, by which SIGTERM kills


@contextmanager
def interrupt_event() -> Iterator[asyncio.Event]:
    """Yields an event that the first signal sets."""
    end = asyncio.Event()
    with on_interrupt(end.set):
        yield end


async def elapsed(end: asyncio.Event, seconds: float | None) -> bool:
    """Waits for `seconds` (without limit when None); returns False when `end` is set before they have elapsed."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await end.wait()
    return not end.is_set()
