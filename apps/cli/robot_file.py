"""Putting measured values into a TOML file that people write in too: all else in it, comments too, stays as it is."""

from __future__ import annotations

import os
import re
import tempfile
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

from cocoro.errors import ConfigError

Value = str | int | float | tuple[float, ...]


def with_values(text: str, table: str, values: Mapping[str, Value], name: str = "") -> str:
    """The text with these values in a table: `[table]`, or with a name the `[[table]]` row that has this name. What is
    not there yet is put at the end."""
    lines = text.splitlines()
    head = f"[[{table}]]" if name else f"[{table}]"
    found = next(
        (part for part in _tables(lines, head) if not name or _named(lines[part[0] + 1 : part[1]], name)), None
    )
    if found is None:
        lines += ["", head] if lines else [head]
        if name:
            lines.append(f'name = "{name}"')
        found = len(lines), len(lines)
    start, end = found
    for key, value in values.items():
        line = f"{key} = {_written(value)}"
        pattern = re.compile(rf"\s*{re.escape(key)}\s*=[^#]*(#.*)?$")
        for number in range(start, end):
            if match := pattern.match(lines[number]):
                lines[number] = f"{line}   {match[1]}" if match[1] else line
                break
        else:
            lines.insert(end, line)
            end += 1
    return "\n".join(lines) + "\n"


def write_values(path: Path, table: str, values: Mapping[str, Value], name: str = "") -> None:
    """The same, in a file, which need not be there yet. Raises ConfigError when it is none that can be written."""
    try:
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        tomllib.loads(text)
        changed = with_values(text, table, values, name)
        tomllib.loads(changed)
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", dir=path.parent, prefix=f".{path.name}.", delete=False, encoding="utf-8"
        ) as file:
            file.write(changed)
        os.chmod(file.name, path.stat().st_mode & 0o777 if path.exists() else 0o644)  # noqa: PTH101
        Path(file.name).replace(path)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is no good TOML: {error}") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from error


def _tables(lines: list[str], head: str) -> list[tuple[int, int]]:
    """Of each table with this head: its first line, and the one behind its last that is neither empty nor a comment."""
    heads = [number for number, line in enumerate(lines) if re.match(r"\s*\[", line) and "=" not in line.split("]")[0]]
    tables = []
    for start, following in pairwise([*heads, len(lines)]):
        if lines[start].split("#")[0].strip() != head:
            continue
        end = following
        while end > start + 1 and (not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#")):
            end -= 1
        tables.append((start, end))
    return tables


def _named(lines: list[str], name: str) -> bool:
    return any(re.match(rf"""\s*name\s*=\s*["']{re.escape(name)}["']\s*(#.*)?$""", line) for line in lines)


def _written(value: Value) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return f"[{', '.join(_written(float(one)) for one in value)}]"
    return str(value) if isinstance(value, int) else f"{value:.10g}" if value % 1 else f"{value:.1f}"
