"""Errors that a user can cause or must know of; commands print their text without a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath


@contextmanager
def naming(path: PathLike[str]) -> Iterator[None]:
    """Adds the path to an OSError in the block: the system names a file that cannot be opened, not one that cannot be
    written."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = fspath(path)
        raise


class CocoroError(Exception):
    """The text says what is wrong, where, and what to do, in one or two sentences."""


class ConfigError(CocoroError):
    """A file or an option has a wrong value. The text names the file and the field."""


class MeshError(CocoroError):
    """The mesh, or the called service, does not exist."""


class CallTimeoutError(MeshError):
    """No service answered a request in time."""


class RemoteError(CocoroError):
    """The called service answered with an error, whose text this is."""


class RefusedError(CocoroError):
    """The request conflicts with something that runs already. The text names it."""
