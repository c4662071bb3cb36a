"""A bench that is ended leaves no robot behind: what it started is stopped on every way out.

Ctrl-C raises KeyboardInterrupt, so that contexts are left and robots are stopped; SIGTERM and the closing of the
terminal would end the process at once instead.
"""

from __future__ import annotations

import signal
from contextlib import suppress
from types import FrameType

import psutil

SIGNALS = (signal.SIGTERM, signal.SIGHUP)


def leave_when_ended() -> None:
    """Make the signals of `SIGNALS` leave all contexts, and Ctrl-C be heard, which a shell has its background jobs
    ignore, and by inheritance all that they start. Call it at the begin of a bench, in its main thread."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in SIGNALS:
        signal.signal(number, _leave)


def _leave(number: int, _frame: FrameType | None) -> None:
    for each in SIGNALS:
        signal.signal(each, lambda *_: None)  # a second one must not interrupt the stopping
    for child in psutil.Process().children():
        with suppress(psutil.Error):
            child.send_signal(signal.SIGINT)  # somebody may wait for it
    raise SystemExit(128 + number)
