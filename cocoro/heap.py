"""Keeps freed memory in the process, for programs that allocate and free a picture many times a second.

The C library gives the memory of large objects back to the system when they are freed, and gets it anew for the next
one: then every page is cleared and mapped again, which costs more than to copy the picture. Glibc decides so by two
thresholds (mallopt(3)), which it adapts to the largest object that was freed so far; two pictures that are freed
together pass them every time.
"""

from __future__ import annotations

import ctypes

KEPT_BYTES = 64 * 1024 * 1024
"""Free memory at the end of the heap that stays with the process: some pictures and what computing on them takes."""
OWN_BYTES = 32 * 1024 * 1024
"""Objects from this size on have a mapping of their own, which goes back at once; glibc's maximum."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3


def keep_freed() -> bool:
    """Sets the thresholds for this process; returns whether its C library has them."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # not glibc
        return False
    return bool(mallopt(_TRIM_THRESHOLD, KEPT_BYTES)) and bool(mallopt(_MMAP_THRESHOLD, OWN_BYTES))


def give_back() -> bool:
    """Gives free memory back to the system, wherever it is in the heap; returns whether the C library can. It takes
    some milliseconds, in which other threads wait for memory, and what is given back costs its pages anew."""
    try:
        malloc_trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):  # not glibc
        return False
    malloc_trim(0)
    return True
