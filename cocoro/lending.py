"""An event loop that lends its turn: while it waits for events, another thread may run a callback in its place.

A message that arrives from another process wakes a thread of zenoh. To wake the loop's thread after that, so that it
handles the message, costs as much again as the whole way of the message: a processor must leave its sleep, and a thread
must get the interpreter. While the loop waits, nobody needs its thread. So the thread that has the message already
takes the loop's turn, handles the message, and gives the turn back. The loop is woken only when it has to go on with
something.

What a callback may rely on stays: it runs alone, between two others of the loop, `asyncio.get_running_loop` is the
loop, and what earlier callbacks wrote is seen. Only the thread is another one: a callback that may run so uses nothing
that belongs to a thread (a GL context, a `threading.local`).
"""

from __future__ import annotations

import asyncio
import selectors
import threading
from asyncio import _set_running_loop
from collections.abc import Callable
from typing import Any


class _Selector(selectors.DefaultSelector):
    """Gives the turn away while it waits."""

    def __init__(self) -> None:
        super().__init__()
        self.turn = threading.Lock()
        """Held by the thread that runs the loop's callbacks; by the loop itself while it does not run."""
        self.turn.acquire()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is not None and timeout <= 0:
            return super().select(timeout)
        self.turn.release()
        try:
            return super().select(timeout)
        finally:
            self.turn.acquire()


class LendingLoop(asyncio.SelectorEventLoop):
    """The loop of a service's process. In asyncio's debug mode it does not lend, since that checks the thread."""

    def __init__(self) -> None:
        selector = _Selector()
        super().__init__(selector)
        self._take = selector.turn.acquire
        self._release = selector.turn.release
        self._lends = not self.get_debug()
        self._lent = False
        self._must_wake = False

    def borrow(self) -> bool:
        """Takes the loop's turn if the loop waits for events; returns whether it did. Then the caller, another thread
        than the loop's, runs one short callback and calls `give_back`. Otherwise the loop is busy or does not run:
        `call_soon_threadsafe` hands work over."""
        if not self._take(False):
            return False
        if not self._lends:
            self._release()
            return False
        self._lent, self._must_wake = True, False
        _set_running_loop(self)
        return True

    def give_back(self) -> None:
        """Ends a borrowed turn, and wakes the loop if it has to go on with something."""
        _set_running_loop(None)
        self._lent = False
        must_wake = self._must_wake
        self._release()
        if must_wake:
            self.call_soon_threadsafe(_nothing)

    def set_debug(self, enabled: bool) -> None:
        self._lends = not enabled
        super().set_debug(enabled)

    # What makes the loop go on, so that it has to be woken after a lent turn.

    def call_soon(  # type: ignore[override] # the stubs type the arguments as a tuple variable
        self, callback: Callable[..., object], *args: Any, context: Any = None
    ) -> asyncio.Handle:
        if self._lent:
            self._must_wake = True
        return super().call_soon(callback, *args, context=context)

    def call_at(  # type: ignore[override] # as above
        self, when: float, callback: Callable[..., object], *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        if self._lent:
            self._must_wake = True
        return super().call_at(when, callback, *args, context=context)

    def stop(self) -> None:
        if self._lent:
            self._must_wake = True
        super().stop()


def _nothing() -> None:
    pass
