"""What OpenCV's films lack: names of any bytes, and being told when a write failed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from cocoro.capture.errors import CaptureError

AHEAD_BYTES = 64 * 1024
"""More than FFmpeg gathers before it writes, so that a write that failed would not have fitted."""


@contextmanager
def spelt_for_opencv(path: Path) -> Iterator[str]:
    """A path as OpenCV takes it, which is in UTF-8 whatever the locale is; another one makes it crash. Such a path is
    given by a link of a plain name while this lasts. Raises CaptureError where there cannot be one."""
    try:
        name = os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        pass
    else:
        yield name
        return
    try:
        with tempfile.TemporaryDirectory() as folder:
            link = os.fsencode(folder).decode("utf-8") + "/film" + path.suffix
            Path(link).symlink_to(path.absolute())
            yield link
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path}: a name in UTF-8 is needed for it, or for TMPDIR") from error


class Complaints:
    """What OpenCV prints on standard error, which is the only place where it says that a write failed. A context
    manager: while it is entered, what is printed is kept from people, and counted."""

    def __init__(self) -> None:
        self._paper = os.memfd_create("complaints")
        self._stderr: int | None = None
        self._read_bytes = 0

    def __enter__(self) -> Complaints:
        try:
            self._stderr = os.dup(2)
        except OSError:  # there is none, and OpenCV says nothing
            return self
        os.dup2(self._paper, 2)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stderr is not None:
            os.dup2(self._stderr, 2)
            os.close(self._stderr)
            self._stderr = None

    def are_new(self) -> bool:
        """Whether anything has been printed since the last call."""
        before, self._read_bytes = self._read_bytes, os.fstat(self._paper).st_size
        return self._read_bytes > before

    def close(self) -> None:
        os.close(self._paper)


def why_not_more(path: Path) -> str:
    """Why a file can grow no further, in the system's words; empty when it can."""
    try:
        with tempfile.TemporaryFile(dir=path.parent, buffering=0) as probe:
            probe.seek(path.stat().st_size)
            left = AHEAD_BYTES
            while left:
                left -= probe.write(bytes(left))
    except OSError as error:
        return error.strerror or str(error)
    return ""
