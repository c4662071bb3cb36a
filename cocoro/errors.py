"""Errors that a user can cause or must know of; commands print their text without a traceback."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from os import PathLike, fspath
from typing import Any, get_args, get_type_hints


def choice_of(given: object, known: Iterable[str]) -> str:
    """Text for a name that is not among the known ones: 'known are red_can, blue_can; did you mean red_can?'."""
    from difflib import get_close_matches

    names = [*known]
    close = get_close_matches(str(given), names, 1)
    return f"known are {', '.join(names) or 'none'}{f'; did you mean {close[0]}?' if close else ''}"


def field_text(error: Exception, kind: Any = None) -> str:
    """msgspec's 'what - at `$.field`' as 'field: what', for an unknown field or value of the struct `kind` with those
    that are known."""
    text, _, path = str(error).partition(" - at `$")
    path, fields = path.strip(".`"), getattr(kind, "__struct_encode_fields__", ())
    if "unknown field `" in text and not path:
        name = text.split("`")[1]
        text = f"unknown field {name!r}; {choice_of(name, fields)}"
    elif "enum value '" in text and path in fields:
        name, hint = text.split("'")[1], get_type_hints(kind)[kind.__struct_fields__[fields.index(path)]]
        text = f"unknown value {name!r}; {choice_of(name, get_args(hint))}"
    return f"{path}: {text}" if path else text


@contextmanager
def naming(path: PathLike[str]) -> Iterator[None]:
    """Adds the path to an OSError in the block: the system names only files that cannot be opened."""
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
    """A request that no service answered in time."""


class RemoteError(CocoroError):
    """The called service answered with an error, whose text this is."""


class RefusedError(CocoroError):
    """The request conflicts with something that runs already. The text names it."""
