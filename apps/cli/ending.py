"""Commands that go on until they are told to end, which is then no error."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def on_end(handler: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C, being told to end and a closed terminal all go to `handler`, for as long as this context lasts. What is
    ignored, as nohup and scripts in the background have it, stays so, but for SIGTERM."""
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in ENDS}
    numbers = [number for number in ENDS if before[number] != signal.SIG_IGN or number == signal.SIGTERM]
    for number in numbers:
        loop.add_signal_handler(number, handler)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])  # the loop leaves Python's own, by which SIGTERM kills


@contextmanager
def told_to_end() -> Iterator[asyncio.Event]:
    """Set by whatever tells a command to end."""
    end = asyncio.Event()
    with on_end(end.set):
        yield end


async def passed(end: asyncio.Event, seconds: float | None) -> bool:
    """Wait so long (for ever, when None); False when it was told to end before."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await end.wait()
    return not end.is_set()
