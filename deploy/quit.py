"""Ends a process without finalizing its interpreter.

While Python finalizes, a thread that asks for the interpreter is ended by unwinding its stack. Zenoh's threads cannot
be unwound: if one of them calls back at that moment, the process aborts ("FATAL: exception not rethrown", exit code
-6), although all work was done and the mesh had been left.
"""

from __future__ import annotations

import atexit
import os
import sys
from contextlib import suppress

TYPE_CHECKING = False
"""As in `typing`, which takes 2 ms to import."""
if TYPE_CHECKING:
    from typing import NoReturn

UNFLUSHED = 120
"""Python's exit code for output that could not be flushed."""


def quit_process(code: int) -> NoReturn:
    """Ends the process with this exit code, after other non-daemon threads have ended, `atexit` functions have run and
    the output is flushed."""
    if (threading := sys.modules.get("threading")) is not None:
        threading._shutdown()  # executors' threads are ended by no public call
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            with suppress(ValueError, AttributeError):  # closed or missing
                stream.flush()
        except OSError:  # no reader any more, or a full disk
            code = code or UNFLUSHED
    os._exit(code)
