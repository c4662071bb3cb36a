"""Ending a process without taking its interpreter apart.

Python ends a thread that asks for an interpreter which is being taken apart by unwinding its stack. Zenoh's threads
do not bear that: they abort the process ("FATAL: exception not rethrown", exit code -6) when one of them comes back
with a last sample in just that moment, though all work was done and the mesh was left.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
from contextlib import suppress
from typing import NoReturn

UNSAID = 120
"""Python's own exit code for it."""


def quit_process(code: int) -> NoReturn:
    """End with this exit code: other threads that are no daemons end first, then what was registered with `atexit`
    is called and what was printed is written."""
    threading._shutdown()  # type: ignore[attr-defined] # with executors' threads, which no public call ends
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            with suppress(ValueError, AttributeError):  # it is closed, or there is none
                stream.flush()
        except OSError:  # nobody reads it any more, or the disk is full: what was printed has not arrived
            code = code or UNSAID
    os._exit(code)
