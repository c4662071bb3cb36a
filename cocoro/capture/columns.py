"""The messages of a topic as columns: one NumPy array for each field."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from cocoro.errors import ConfigError, choice_of

Column = NDArray[Any]
NUMBERS = (int, float)
HEAD = ("stamp_ns", "seq", "incarnation")
"""The fields that every message has."""


class Columns(Mapping[str, Column]):
    """Columns of equal length by name, in the order of the fields.

    A field of a struct within a message is named with dots: `target.age_s`. Numbers are int64, float64 or bool; where
    one is missing they are float64 with NaN. Fixed tuples of numbers are one column of shape (rows, length). Texts, and
    what has no fixed shape, are columns of objects, None where they are missing.
    """

    def __init__(self, head: Mapping[str, Column], messages: Sequence[Any]) -> None:
        """`head`: columns beside those of the messages, which are structs of one type or maps. A field's columns are
        made when they are used first."""
        self._columns: dict[str, dict[str, Column] | None] = {name: {name: column} for name, column in head.items()}
        """The columns of each field, in order; None before they are made."""
        self._columns |= dict.fromkeys(_names(messages))
        self._messages = messages
        self.rows = len(messages)
        """Number of messages."""

    def __getitem__(self, name: str) -> Column:
        for field in self._columns:
            if (name == field or name.startswith(f"{field}.")) and (column := self._of(field).get(name)) is not None:
                return column
        raise MissingColumnError(f"no column {name!r}; {choice_of(name, self)}")

    def __iter__(self) -> Iterator[str]:
        return chain.from_iterable(self._of(field) for field in self._columns)

    def __len__(self) -> int:
        return sum(len(self._of(field)) for field in self._columns)

    def __contains__(self, name: object) -> bool:
        return name in [*self]

    def _of(self, field: str) -> dict[str, Column]:
        made = self._columns[field]
        if made is None:
            made = self._columns[field] = _columns(field, _values(self._messages, field))
        return made

    def __repr__(self) -> str:
        return f"<{self.rows} rows: {', '.join(self)}>"

    def exploded(self, name: str) -> Columns:
        """A column of tuples of structs, such as `detections`, as columns of its own with a row for each item: its
        fields, and in `row` the number of the message that it is of. Raises MissingColumnError."""
        column = self[name]
        items = list(chain.from_iterable(each for each in column if each is not None))
        lengths = [0 if each is None else len(each) for each in column]
        return Columns({"row": np.repeat(np.arange(self.rows), lengths)}, items)

    def flat(self) -> dict[str, Column]:
        """All columns with one value a row: those of tuples are split, and named with their numbers, `odometry_m.0`."""
        return dict(chain.from_iterable(_split(name, column) for name, column in self.items()))

    def to_pandas(self) -> Any:
        """A pandas.DataFrame of `flat`. Raises ConfigError when pandas is not installed."""
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise ConfigError("to_pandas needs pandas: pip install pandas; `flat` gives the same as arrays") from error
        return pandas.DataFrame(self.flat())

    def to_arrow(self) -> Any:
        """A pyarrow table of `flat`. Raises ConfigError when pyarrow is not installed."""
        try:
            import pyarrow
        except ModuleNotFoundError as error:
            raise ConfigError("to_arrow needs pyarrow: pip install 'cocoro-mesh[tables]'") from error
        return pyarrow.table({name: _arrow(pyarrow, column) for name, column in self.flat().items()})


class MissingColumnError(ConfigError, KeyError):
    """There is no such topic or column; the text lists those that there are."""

    def __str__(self) -> str:
        return str(self.args[0])  # a KeyError would quote it


def flattened(messages: Sequence[Any], prefix: str = "") -> dict[str, Column]:
    """All columns of messages: structs of one type, or maps; None for one that is missing."""
    found: dict[str, Column] = {}
    for name in _names(messages):
        found.update(_columns(f"{prefix}{name}", _values(messages, name)))
    return found


def _names(messages: Sequence[Any]) -> list[str]:
    """The fields of messages: those of every message first, then those of this kind in their own order."""
    kinds = set(map(type, messages))
    kind = next((each for each in kinds if issubclass(each, msgspec.Struct)), None)
    if kind is not None:
        return _in_order(kind.__struct_fields__)
    return _in_order(dict.fromkeys(chain.from_iterable(message for message in messages if message is not None)))


def _values(messages: Sequence[Any], name: str) -> list[Any]:
    """A field of each message; None where message or field are missing."""
    kinds = set(map(type, messages))
    if any(issubclass(kind, msgspec.Struct) for kind in kinds):
        take = attrgetter(name)
        return (
            [None if each is None else take(each) for each in messages]
            if type(None) in kinds
            else [*map(take, messages)]
        )
    return [None if message is None else message.get(name) for message in messages]


def _in_order(names: Iterable[Any]) -> list[str]:
    return sorted(map(str, names), key=lambda name: HEAD.index(name) if name in HEAD else len(HEAD))


def _columns(name: str, values: list[Any]) -> dict[str, Column]:
    """The columns of one field. The type of the first value decides, if all others fit it."""
    kinds = set(map(type, values))
    given = kinds - {type(None)}
    if given == {bool} and kinds == given:
        return {name: np.array(values, dtype=np.bool_)}
    if given == {int} and kinds == given:
        return {name: _integers(values)}
    if given and given <= {*NUMBERS}:
        return {name: np.array(values, dtype=np.float64)}
    if len(given) == 1 and issubclass(next(iter(given)), (msgspec.Struct, Mapping)):
        return flattened(values, f"{name}.")
    if given and given <= {tuple, list} and (block := _block(values)) is not None:
        return {name: block}
    return {name: _objects(values)}


def _integers(values: list[Any]) -> Column:
    try:
        return np.array(values, dtype=np.int64)
    except OverflowError:
        return _objects(values)


def _block(values: list[Any]) -> Column | None:
    """Tuples of numbers of one length as an array of shape (rows, length), NaN where one is missing; else None."""
    lengths = {len(value) for value in values if value is not None}
    if len(lengths) != 1 or not (length := lengths.pop()):
        return None
    kinds = set(map(type, chain.from_iterable(value for value in values if value is not None)))
    if not kinds <= {*NUMBERS}:
        return None
    whole = kinds == {int} and None not in values
    missing = (float("nan"),) * length
    filled = values if whole else [missing if value is None else value for value in values]
    return np.array(filled, dtype=np.int64 if whole else np.float64)


def _objects(values: Sequence[Any]) -> Column:
    column = np.empty(len(values), dtype=object)
    for row, value in enumerate(values):
        column[row] = value
    return column


def _split(name: str, column: Column) -> Iterator[tuple[str, Column]]:
    if column.ndim == 1:
        yield name, column
    else:
        yield from ((f"{name}.{number}", column[:, number]) for number in range(column.shape[1]))


def _arrow(pyarrow: Any, column: Column) -> Any:
    plain = column.tolist() if column.dtype == object else column
    try:
        return pyarrow.array(plain)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError):  # structs, or values of several types: as text
        return pyarrow.array([None if value is None else str(value) for value in plain])
