"""The errors that a user can cause or must know of; the CLI shows their text and no traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath


@contextmanager
def naming(path: PathLike[str]) -> Iterator[None]:
    """While a file is written: the system says which file could not be opened, but not which could not be written."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = fspath(path)
        raise


class CocoroError(Exception):
    """What went wrong, where, and what to do about it, in one sentence or two."""


class ConfigError(CocoroError):
    """A file or an option has a wrong value; the text names the file and the field."""


class MeshError(CocoroError):
    """The mesh, or the service that is asked, is not there."""


class CallTimeoutError(MeshError):
    """Nobody answered a request in time."""


class RemoteError(CocoroError):
    """The service that was asked answered with an error; the text is the service's own."""


class RefusedError(CocoroError):
    """What was asked cannot be now, because of something that is there already; the text says what."""
