"""What `cocoro new` writes of any kind: names, folders, files, and the word on what was written."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from apps.cli.output import print_json
from cocoro.errors import ConfigError

NAME = r"[a-z][a-z0-9_-]{0,31}"
"""Valid names: a chunk of a key, and with '_' for '-' a Python package."""


def put(path: Path, text: str) -> None:
    """Writes a file, and its folder. Raises ConfigError when it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from error


def free_folder(name: str, into: Path) -> Path:
    """The folder `into`/`name`. Raises ConfigError when there is something of that name."""
    folder = into / name
    if folder.exists():
        raise ConfigError(f"{folder} exists already; choose another name, or another place with --into")
    return folder


def check_name(name: str) -> None:
    """Raises ConfigError for a name that is not valid."""
    if not re.fullmatch(NAME, name):
        raise ConfigError(f"{name!r} is not a valid name: small letters, digits, '_' and '-', a letter first")


def tell_of(made: list[Path], where: str, hints: Iterable[tuple[str, str]], as_json: bool) -> None:
    """Prints the new files, where to begin, and what to do next."""
    if as_json:
        print_json({"files": [str(path) for path in made], "next": [command for command, _ in hints]})
        return
    print(*made, f"\n{where} Next:", sep="\n")
    hints = tuple(hints)
    width = max(len(command) for command, _ in hints)
    for command, what in hints:
        print(f"  {command:<{width}}  # {what}")
