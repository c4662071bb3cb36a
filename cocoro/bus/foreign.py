"""Threads that are not Python's, but call it: those of zenoh.

CPython makes a state for such a thread when a call begins, and destroys it when that call ends. For each message that
is a mapping of memory, a fault of a page and an unmapping, of which every processor of this process is told.
"""

from __future__ import annotations

import ctypes
import threading


class _ThisThread(threading.local):
    state_kept = False


_this_thread = _ThisThread()


def keep_thread_state() -> None:
    """Keeps the state of the calling thread until the thread ends; to be called in each call of such a thread, since
    another thread may have the next one. What a thread keeps (`threading.local`, context variables) then stays from
    call to call."""
    if not _this_thread.state_kept:
        _this_thread.state_kept = True
        ctypes.pythonapi.PyGILState_Ensure()  # never released: the caller's release then leaves the state alone
