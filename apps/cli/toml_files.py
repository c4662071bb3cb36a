"""Values and objects put into TOML files that people edit too: comments, order and all other values stay.

Two kinds of files are written: a robot's own file or a profile (`write_values`), and a catalogue of objects (`save`).
"""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Mapping, MutableMapping
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Array, InlineTable, Item, Table, Whitespace

from cocoro.errors import ConfigError
from cocoro.objects import Catalogue, LabBox, ObjectSpec, own_text

Value = str | int | float | tuple[float, ...]
OBJECTS = "object"
LABEL = "label"


# --- measured values ------------------------------------------------------------------------------


def with_values(text: str, table: str, values: Mapping[str, Value], name: str = "") -> str:
    """The text with these values in `[table]` (dotted: `network.arm`), or with `name` in the `[[table]]` row that has
    this name. A table or row that is missing is added. Raises ConfigError when the text is no TOML, or has something
    else in the table's place."""
    document = _parsed(text)
    items = {key: _item(value) for key, value in values.items()}
    *outer, last = table.split(".")
    place = _row(_table(document, outer), last, "name", name) if name else _table(document, [*outer, last])
    for key, item in items.items():
        _put(place, key, item)

    def edit(data: dict[str, Any]) -> None:
        for key in outer:
            data = data.setdefault(key, {})
        row = _plain_row(data.setdefault(last, []), "name", name) if name else data.setdefault(last, {})
        row.update(_plain_values(items))

    heading = tomlkit.key([*outer, last]).as_string()
    lines = [f"[[{heading}]]", f"name = {tomlkit.item(name).as_string()}"] if name else [f"[{heading}]"]
    return _verified(text, [tomlkit.dumps(document), _appended(text, lines, items)], edit, f"[{table}]")


def write_values(path: Path, table: str, values: Mapping[str, Value], name: str = "") -> None:
    """Set values in a file's table as `with_values` does. The file is made where there is none, and replaced as a
    whole. Raises ConfigError, with the file as it was and the values in the message, when it is no TOML or cannot be
    written."""
    try:
        text = path.read_bytes().decode() if path.exists() else ""
        _replace(path, with_values(text, table, values, name))
    except (ConfigError, UnicodeDecodeError, OSError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        heading, named = (f"[[{table}]]", {"name": name}) if name else (f"[{table}]", {})
        lines = ", ".join(f"{key} = {_item(value).as_string()}" for key, value in {**named, **values}.items())
        raise ConfigError(f"{path} is not changed: {why}; write by hand, in {heading}: {lines}") from error


# --- known objects --------------------------------------------------------------------------------


def with_object(text: str, known: ObjectSpec) -> str:
    """A catalogue's text with the object's values in the row of its label, or in a new row at the end. Raises
    ConfigError when the text is no TOML, or its `object` is no list of tables."""
    document = _parsed(text)
    row = _row(document, OBJECTS, LABEL, known.label)
    items = _object_items(known)
    for key in [key for key in row if key not in items and key != LABEL]:
        del row[key]
    for key, item in items.items():
        _put(row, key, item)

    def edit(data: dict[str, Any]) -> None:
        plain = _plain_row(data.setdefault(OBJECTS, []), LABEL, known.label)
        plain.clear()
        plain.update(_plain_values(items))

    return _verified(text, [tomlkit.dumps(document)], edit, f"[[{OBJECTS}]] {known.label}")


def text_of(path: Path) -> str:
    """The text of a catalogue's file, or of the project's own where there is no such file. Raises ConfigError."""
    try:
        return path.read_bytes().decode()
    except FileNotFoundError:
        return own_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"known objects {path}: {error}") from error


def save(path: Path, known: ObjectSpec) -> Catalogue:
    """Put the object into the file, which is replaced as a whole, and return the catalogue that it holds then. Raises
    ConfigError, with the file as it was, when the result would be no catalogue or cannot be written."""
    try:
        text = with_object(text_of(path), known)
    except ConfigError as error:
        raise ConfigError(f"known objects {path}: {error}") from error
    catalogue = Catalogue.from_text(text, str(path))
    try:
        _replace(path, text)
    except OSError as error:
        raise ConfigError(f"known objects {path}: {error.strerror}; choose another place with --catalogue") from error
    return catalogue


def _object_items(known: ObjectSpec) -> dict[str, Item]:
    """The object's fields in the order and layout of the project's own catalogue."""
    values: dict[str, Any] = {
        LABEL: known.label, "shape": known.shape, "radius_m": known.radius_m, "height_m": known.height_m,
        "size_m": known.box_m, "mass_kg": known.mass_kg, "graspable": known.graspable,
        "marker": known.marker or None, "rgb": known.rgb,
    }  # fmt: skip
    items = {name: _item(value, 6) for name, value in values.items() if value is not None}
    items["lab"] = _boxes(known.lab)
    if known.lab_by_shape:
        items["lab_by_shape"] = _boxes(known.lab_by_shape)
    return items


def _boxes(boxes: Iterable[LabBox]) -> Array:
    """One box a line."""
    array = tomlkit.array()
    for box in boxes:
        row = tomlkit.inline_table()
        row.update({"low": _item(_whole(box.low), 6), "high": _item(_whole(box.high), 6)})
        array.append(row)
    return array.multiline(multiline=True)


def _whole(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(int(value) if value == int(value) else value for value in values)


# --- editing --------------------------------------------------------------------------------------


def _parsed(text: str) -> tomlkit.TOMLDocument:
    try:
        tomllib.loads(text)
        return tomlkit.parse(text if text.endswith("\n") or not text else text + "\n")
    except (tomllib.TOMLDecodeError, TOMLKitError) as error:
        raise ConfigError(f"not valid TOML: {error}") from error


def _item(value: Value | bool, digits: int = 10) -> Item:
    """A value as it is written, numbers with so many significant digits at most."""
    if isinstance(value, tuple):
        array = tomlkit.array()
        array.extend([one if isinstance(one, int) else float(f"{one:.{digits}g}") for one in value])
        return array
    return tomlkit.item(float(f"{value:.{digits}g}") if isinstance(value, float) else value)


def _table(place: Any, path: Iterable[str]) -> Any:
    """The table at the end of a path of keys; those that are missing are added."""
    for key in path:
        if key not in place:
            _put(place, key, tomlkit.inline_table() if isinstance(place, InlineTable) else tomlkit.table())
        place = place[key]
        if not isinstance(place, MutableMapping):
            raise ConfigError(f"{key} is no table")
    return place


def _row(place: Any, key: str, field: str, value: str) -> Any:
    """The row whose `field` has this value, in `[[key]]` or in a list of inline tables; added where it is missing."""
    if key not in place:
        if isinstance(place, tomlkit.TOMLDocument) and place.body:
            place.add(tomlkit.nl())
        place[key] = tomlkit.aot()
    rows = place[key]
    if not isinstance(rows, AoT | Array) or not all(isinstance(row, MutableMapping) for row in rows):
        raise ConfigError(f"{key} is no list of tables")
    for row in rows:
        if row.get(field) == value:
            return row
    if isinstance(rows, Array):
        inline = tomlkit.inline_table()
        inline[field] = value
        rows.append(inline)
        return rows[-1]
    table = tomlkit.table()
    table[field] = value
    following = _cut_comments(rows)
    rows.append(table)
    rows[-1].value.body.extend(following)
    return rows[-1]


def _cut_comments(rows: AoT) -> list[Any]:
    """Take the blank lines and comments off the end of the last row, which belong to what follows it, and leave one
    blank line there."""
    if not len(rows):
        return []
    body = rows[-1].value.body
    start = len(body)
    while start and body[start - 1][0] is None:
        start -= 1
    cut = list(body[start:])
    body[start:] = [(None, Whitespace("\n"))]
    return cut


def _put(place: Any, key: str, item: Item) -> None:
    """Set a key where it stands, or behind the last plain value of its table, before comments on what follows. A value
    that is equal keeps its form."""
    if key in place and tomlkit.item(place[key]).unwrap() == item.unwrap():
        return
    if key in place or not isinstance(place, Table):
        place[key] = item
        return
    plain = [old for old, value in place.value.body if old is not None and not isinstance(value, Table | AoT)]
    if plain and not isinstance(item, Table | AoT):
        place.value._insert_after(plain[-1], key, item)
    else:
        place[key] = item


def _plain_row(rows: list[dict[str, Any]], field: str, value: str) -> dict[str, Any]:
    found = next((row for row in rows if row.get(field) == value), None)
    if found is None:
        rows.append(found := {field: value})
    return found


def _plain_values(items: Mapping[str, Item]) -> dict[str, Any]:
    return {key: tomllib.loads(f"v = {item.as_string()}", parse_float=_exact)["v"] for key, item in items.items()}


def _exact(number: str) -> Decimal | str:
    """A number that compares equal to itself, also when it is not one."""
    return number if "nan" in number else Decimal(number)


def _appended(text: str, heading: Iterable[str], items: Mapping[str, Item]) -> str:
    """The text with a new table at its end."""
    lines = ["", *heading, *(f"{tomlkit.key(key).as_string()} = {item.as_string()}" for key, item in items.items())]
    return f"{text.rstrip()}\n" + "\n".join(lines) + "\n"


def _verified(text: str, edited: Iterable[str], edit: Callable[[dict[str, Any]], None], where: str) -> str:
    """The first of the edited texts that holds what `text` holds with the edit done to it: tomlkit puts a table that it
    adds below a dotted key before keys which then fall into it. Raises ConfigError where there is none."""
    wanted = tomllib.loads(text, parse_float=_exact)
    edit(wanted)
    for changed in edited:
        with suppress(tomllib.TOMLDecodeError):
            if tomllib.loads(changed, parse_float=_exact) == wanted:
                return changed
    raise ConfigError(f"{where} cannot be edited by a program in its present form")


def _replace(path: Path, text: str) -> None:
    """Replace a file as a whole; it keeps its permissions. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fd, draft = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(fd, "wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        Path(draft).chmod(path.stat().st_mode & 0o777 if path.exists() else 0o644)
        Path(draft).replace(path)
    except OSError:
        Path(draft).unlink(missing_ok=True)
        raise
