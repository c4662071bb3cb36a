"""Whether two messages mean the same, and if not, where they differ first."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

EXACT = re.compile(r"(_ns|seq|incarnation|_id|step)$")
"""Names of numbers that no computation makes: they have no tolerance."""
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


class Difference(NamedTuple):
    path: str
    """Of the field: 'detections[0].position_m[1]'."""
    recorded: Any
    now: Any

    @property
    def text(self) -> str:
        by = ""
        if _number(self.recorded) and _number(self.now):
            by = f", by {abs(self.recorded - self.now):.6g}"
        return f"{self.path or 'the whole'} was {_short(self.recorded)} and is {_short(self.now)}{by}"


def difference(recorded: Any, now: Any, tolerance: float = 0.0) -> Difference | None:
    """The first difference between two values made of maps, lists, texts, bytes and numbers; None when there is none.

    Numbers are equal when they differ by no more than `tolerance` times the largest of 1 and both of them; so are the
    numbers within texts. With 0 they must be the same numbers, to the bit but for the sign of zero.
    """
    return _difference(recorded, now, tolerance, "")


def _difference(recorded: Any, now: Any, tolerance: float, path: str) -> Difference | None:
    if isinstance(recorded, Mapping) and isinstance(now, Mapping):
        for name in (*recorded, *(name for name in now if name not in recorded)):
            where = f"{path}.{name}" if path else str(name)
            if name not in recorded or name not in now:
                return Difference(where, recorded.get(name, _Absent()), now.get(name, _Absent()))
            allowed = 0.0 if EXACT.search(str(name)) else tolerance
            if found := _difference(recorded[name], now[name], allowed, where):
                return found
        return None
    if _list(recorded) and _list(now):
        if len(recorded) != len(now):
            return Difference(f"{path} (its length)", len(recorded), len(now))
        for index, (one, other) in enumerate(zip(recorded, now, strict=True)):
            if found := _difference(one, other, tolerance, f"{path}[{index}]"):
                return found
        return None
    return None if _same(recorded, now, tolerance) else Difference(path, recorded, now)


def _same(one: Any, other: Any, tolerance: float) -> bool:
    if _number(one) and _number(other):
        if one == other or (math.isnan(one) and math.isnan(other)):
            return True
        return bool(abs(one - other) <= tolerance * max(1.0, abs(one), abs(other)))
    if isinstance(one, str) and isinstance(other, str) and tolerance and one != other:
        return NUMBER.sub("#", one) == NUMBER.sub("#", other) and all(
            _same(float(a), float(b), tolerance)
            for a, b in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True)
        )
    return type(one) is type(other) and bool(one == other)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes | memoryview)


class _Absent:
    def __repr__(self) -> str:
        return "absent"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
