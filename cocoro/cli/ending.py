"""Commands that go on until they are told to end, which is then no error."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def told_to_end() -> Iterator[asyncio.Event]:
    """Set by Ctrl-C and by SIGTERM, for as long as this context lasts."""
    loop, end = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end.set)
    try:
        yield end
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)


async def passed(end: asyncio.Event, seconds: float | None) -> bool:
    """Wait so long (for ever, when None); False when it was told to end before."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await end.wait()
    return not end.is_set()
