"""Folders for Unix sockets. A socket's path takes at most 107 bytes, so these depend neither on TMPDIR nor on the login
name, which pytest's own temporary folders contain."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def short_folder() -> Path:
    """Make a folder in /tmp, or in TMPDIR where that is shorter; the caller removes it."""
    return Path(tempfile.mkdtemp(prefix="cocoro", dir=min(tempfile.gettempdir(), "/tmp", key=len)))


@contextmanager
def in_short_folder() -> Iterator[Path]:
    """A short folder that is removed at the end."""
    place = min(tempfile.gettempdir(), "/tmp", key=len)
    with tempfile.TemporaryDirectory(prefix="cocoro", dir=place, ignore_cleanup_errors=True) as folder:
        yield Path(folder)
