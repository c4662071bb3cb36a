"""Memory of large arrays and messages, which are made anew for each frame."""

from __future__ import annotations

import numpy as np


def keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next frame. Returning it to the system and faulting in fresh pages 30 times
    a second would cost as much as drawing the depth picture. glibc raises its limit to the largest block that was
    freed; with another C library this does nothing."""
    largest = np.empty(31 * 1024 * 1024, np.uint8)
    del largest
