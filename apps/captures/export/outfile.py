"""A file that an export makes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cocoro.capture.errors import CaptureError


def refuse_existing(out: Path) -> None:
    """An export writes over nothing: it might be the capture. Raises CaptureError."""
    if out.exists():
        raise CaptureError(f"{out} is there already; remove it, or choose another name")


@contextmanager
def making(out: Path) -> Iterator[None]:
    """While a file is made; one that failed does not stay. Raises CaptureError where none can be made."""
    refuse_existing(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.touch()
    except OSError as error:
        raise CaptureError(f"{out}: {error.strerror}") from error
    try:
        out.unlink()
        yield
    except BaseException:
        out.unlink(missing_ok=True)
        raise
