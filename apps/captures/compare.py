"""Compares recorded messages and schemas with today's."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

EXACT = re.compile(r"(_ns|seq|incarnation|_id|step)$")
"""Names of fields that are not computed; they have no tolerance."""
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


class Difference(NamedTuple):
    path: str
    """Path of the field, such as 'detections[0].position_m[1]'."""
    recorded: Any
    now: Any

    @property
    def text(self) -> str:
        by = ""
        if _number(self.recorded) and _number(self.now):
            by = f", by {abs(self.recorded - self.now):.6g}"
        return f"{self.path or 'the whole'} was {_short(self.recorded)} and is {_short(self.now)}{by}"


def difference(recorded: Any, now: Any, tolerance: float = 0.0) -> Difference | None:
    """The first difference between two values made of maps, lists, texts, bytes and numbers; None when they are equal.

    Two numbers are equal when they differ by at most `tolerance` times the largest of 1 and their absolute values;
    numbers within texts likewise. With a tolerance of 0 they must be equal to the bit, except for the sign of zero.
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


class Change(NamedTuple):
    text: str
    readable: bool
    """Whether recorded messages can still be read as today's type, by the rules of `cocoro.capture.types`. False for a
    changed field type, which may or may not fit."""


def changes(recorded: bytes, today: bytes) -> list[Change]:
    """Differences of today's JSON schema from the recorded one that a reader could notice."""
    try:
        old, new = json.loads(recorded), json.loads(today)
    except ValueError:
        return [Change("the recorded schema is no JSON", readable=False)]
    if not isinstance(old, dict) or not isinstance(new, dict):
        return [Change("the recorded schema is no object", readable=False)]
    found = list(_object_changes(old, new, ""))
    for name, part in new.get("$defs", {}).items():
        before = old.get("$defs", {}).get(name)
        if isinstance(before, dict):
            found += _object_changes(before, part, f"{name}.")
    return found


def _object_changes(old: Mapping[str, Any], new: Mapping[str, Any], where: str) -> Iterator[Change]:
    before, after = old.get("properties", {}), new.get("properties", {})
    required = set(new.get("required", ()))
    for name in sorted(set(before) - set(after)):
        yield Change(f"{where}{name} is gone: ignored", readable=True)
    for name in sorted(set(after) - set(before)):
        if name in required:
            yield Change(f"{where}{name} is new and has no default", readable=False)
        else:
            yield Change(f"{where}{name} is new: gets its default", readable=True)
    for name in sorted(set(before) & set(after)):
        if not _fits(_comparable(before[name]), _comparable(after[name])):
            yield Change(f"{where}{name} has changed", readable=False)


def _fits(old: Any, new: Any) -> bool:
    """Whether every value of the old schema surely is one of the new: they are equal, or a choice of texts has become
    any text."""
    choice = isinstance(old, dict) and old.keys() == {"enum"} and all(isinstance(one, str) for one in old["enum"])
    return bool(old == new or (choice and new == {"type": "string"}))


def known_to(recorded: bytes, value: Any) -> Any:
    """A message, made of maps and lists, without the fields that the recorded schema lacks; the whole message when the
    schema cannot be parsed."""
    root = _parsed(recorded)
    return value if root is None else _known(root, root, value)


@cache
def _parsed(schema: bytes) -> dict[str, Any] | None:
    try:
        root = json.loads(schema)
    except ValueError:
        return None
    return root if isinstance(root, dict) else None


def _known(root: Mapping[str, Any], node: Any, value: Any) -> Any:
    node = _resolved(root, node, value)
    if isinstance(value, Mapping):
        fields, others = node.get("properties"), node.get("additionalProperties")
        if fields is not None:
            return {name: _known(root, fields[name], item) for name, item in value.items() if name in fields}
        return {name: _known(root, others, item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        first, rest = node.get("prefixItems", ()), node.get("items")
        return [_known(root, first[n] if n < len(first) else rest, item) for n, item in enumerate(value)]
    return value


def _resolved(root: Mapping[str, Any], node: Any, value: Any) -> Mapping[str, Any]:
    """The schema node behind references, and of alternatives the one that fits the value's kind."""
    if not isinstance(node, dict):
        return {}
    if "$ref" in node:
        return _resolved(root, root.get("$defs", {}).get(str(node["$ref"]).rpartition("/")[2]), value)
    kind = "object" if isinstance(value, Mapping) else "array" if isinstance(value, list | tuple) else ""
    for part in node.get("anyOf", ()):
        found = _resolved(root, part, value)
        if found.get("type") == kind:
            return found
    return node


def _comparable(node: Any) -> Any:
    """The node without descriptions, titles and defaults, which do not affect whether a value fits."""
    if isinstance(node, dict):
        return {
            name: _comparable(value) for name, value in node.items() if name not in ("description", "title", "default")
        }
    return [_comparable(item) for item in node] if isinstance(node, list) else node
