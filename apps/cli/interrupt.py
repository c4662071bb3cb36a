"""The ways in which a person ends a command, or lets go of it: signals, and readers of its output that have gone."""

from __future__ import annotations

import asyncio
import select
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from apps.cli import output

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, `kill`, and the closing of the terminal: they end every command."""
HANDS_OFF = (*SIGNALS, signal.SIGQUIT, signal.SIGTSTP)
"""These end a command that moves the robot. Ctrl-Z (SIGTSTP), too: nobody can interrupt a suspended command."""


@contextmanager
def on_signals(
    numbers: Iterable[signal.Signals], handler: Callable[[signal.Signals], None], *, hurried: bool = False
) -> Iterator[None]:
    """Calls `handler`, in the event loop, at each of these signals while the context lasts. A write that waits for a
    reader is given up then, so that it does not keep the loop from the handler; with `hurried` so are all later ones.

    A signal that the process ignores stays ignored (nohup, and scripts in the background), except SIGTERM.
    """
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in numbers}
    kept = [number for number in before if before[number] != signal.SIG_IGN or number == signal.SIGTERM]
    for number in kept:
        loop.add_signal_handler(number, handler, number)
        # The loop's own handler, which does nothing, would let a waiting write wait on.
        signal.signal(number, lambda *_: output.give_up_waiting(hurried))
    try:
        with output.interruptible():
            yield
    finally:
        for number in kept:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])  # the loop restores Python's default, by which SIGTERM kills


@contextmanager
def interrupt_event() -> Iterator[asyncio.Event]:
    """Yields an event that the first signal sets: for commands that run until they are interrupted, which is then a
    normal end."""
    end = asyncio.Event()
    with on_signals(SIGNALS, lambda _number: end.set()):
        yield end


@contextmanager
def on_reader_gone(handler: Callable[[], None]) -> Iterator[None]:
    """Calls `handler`, in the event loop, when nobody can read standard output or standard error any more: the pipe's
    reader has ended, the terminal was closed. A file has no reader that could go."""
    loop = asyncio.get_running_loop()
    with ExitStack() as stack:
        for fd in (1, 2):
            # An epoll that is asked for nothing still reports the loss of the other end, and nothing else.
            poll = stack.enter_context(select.epoll())
            with suppress(OSError):  # a file
                poll.register(fd, 0)
                loop.add_reader(poll.fileno(), _gone, loop, poll, handler)
                stack.callback(loop.remove_reader, poll.fileno())
        yield


def _gone(loop: asyncio.AbstractEventLoop, poll: select.epoll, handler: Callable[[], None]) -> None:
    loop.remove_reader(poll.fileno())  # it would be reported again and again
    handler()


async def elapsed(end: asyncio.Event, seconds: float | None) -> bool:
    """Waits for `seconds` (without limit when None); returns False when `end` is set before they have elapsed."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await end.wait()
    return not end.is_set()
