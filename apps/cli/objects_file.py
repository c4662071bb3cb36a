"""Writing the catalogue: an object's table as text, put into a file that people write in too."""

from __future__ import annotations

import os
import tempfile
import tomllib
from contextlib import suppress
from pathlib import Path

from cocoro.errors import ConfigError
from cocoro.objects import Catalogue, LabBox, ObjectSpec, own_text

HEAD = "[[object]]"


def as_toml(known: ObjectSpec) -> str:
    """The object as an [[object]] table, in the manner of the project's own file."""
    lines = [HEAD, f'label = "{known.label}"', f'shape = "{known.shape}"']
    for name, value in (("radius_m", known.radius_m), ("height_m", known.height_m)):
        if value is not None:
            lines.append(f"{name} = {_number(value)}")
    if known.box_m is not None:
        lines.append(f"size_m = {_numbers(known.box_m)}")
    lines += [f"mass_kg = {_number(known.mass_kg)}", f"graspable = {'true' if known.graspable else 'false'}"]
    if known.marker:
        lines.append("marker = true")
    lines.append(f"rgb = {_numbers(known.rgb)}")
    lines += _boxes("lab", known.lab)
    if known.lab_by_shape:
        lines += _boxes("lab_by_shape", known.lab_by_shape)
    return "\n".join(lines) + "\n"


def _boxes(name: str, boxes: tuple[LabBox, ...]) -> list[str]:
    rows = [f"    {{ low = {_numbers(box.low)}, high = {_numbers(box.high)} }}," for box in boxes]
    return [f"{name} = [", *rows, "]"]


def _numbers(values: tuple[float, ...]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _number(value: float) -> str:
    return f"{value:.6g}"


def with_object(text: str, known: ObjectSpec) -> str:
    """A catalogue's text with the object in it: in place of its own table if it has one, else at the end. All else,
    comments too, stays as it is."""
    lines = text.splitlines()
    for start, end in _tables(lines):
        if _label(lines[start:end]) == known.label:
            return "\n".join([*lines[:start], *as_toml(known).splitlines(), *lines[end:]]) + "\n"
    return f"{text.rstrip()}\n\n{as_toml(known)}" if text.strip() else as_toml(known)


def _tables(lines: list[str]) -> list[tuple[int, int]]:
    """First line of each table, and the one behind its last; comments before the next table are the next one's."""
    starts = [number for number, line in enumerate(lines) if line.split("#")[0].strip() == HEAD]
    tables = []
    for start, following in zip(starts, [*starts[1:], len(lines)], strict=True):
        end = following
        while end > start + 1 and (not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#")):
            end -= 1
        tables.append((start, end))
    return tables


def _label(lines: list[str]) -> str | None:
    with suppress(tomllib.TOMLDecodeError, KeyError, IndexError):
        label = tomllib.loads("\n".join(lines))["object"][0].get("label")
        return label if isinstance(label, str) else None
    return None


def text_of(path: Path) -> str:
    """What stands in a catalogue's file; that of the project's own where there is no such file yet."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return own_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"known objects {path}: {error}") from error


def save(path: Path, known: ObjectSpec) -> Catalogue:
    """Put the object into the file, all at once, and return the catalogue that it is now. Raises ConfigError, with the
    file as it was, when the result would be no catalogue or cannot be written."""
    text = with_object(text_of(path), known)
    catalogue = Catalogue.from_text(text, str(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fd, draft = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(fd, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        mode = path.stat().st_mode & 0o777 if path.exists() else 0o644
        Path(draft).chmod(mode)
        Path(draft).replace(path)
    except OSError as error:
        raise ConfigError(f"known objects {path}: {error.strerror}; choose another place with --catalogue") from error
    return catalogue
