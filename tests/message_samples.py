"""Messages of every type for property-based tests, as plain data: as MessagePack decodes them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import msgspec
from hypothesis import strategies as st
from msgspec import inspect

from cocoro.messages import LARGEST, FloorPlan, Frame, Intent, Message, PolicyActions, ServoCommand, ServoState
from cocoro.messages.actions import ACTIONS
from cocoro.topics import REQUESTS, TOPICS

MESSAGES: tuple[type[Message], ...] = tuple(dict.fromkeys(topic.type for topic in TOPICS))
QUESTIONS = tuple(dict.fromkeys(kind for request in REQUESTS for kind in (request.request, request.reply)))

Data = dict[str, Any]
Path = tuple[str | int, ...]


def data_of(kind: type[msgspec.Struct]) -> st.SearchStrategy[Data]:
    """Plain data of valid messages of a type."""
    return _data_of(kind)


@cache
def _data_of(kind: type[msgspec.Struct]) -> st.SearchStrategy[Data]:
    fields = _fields(inspect.type_info(kind))
    if issubclass(kind, Frame):
        return st.builds(_frame, fields, st.integers(1, 4), st.integers(1, 4))
    if issubclass(kind, FloorPlan):
        return st.builds(_floor_plan, fields, st.integers(0, 4), st.integers(0, 4))
    if issubclass(kind, Intent):
        actions = [_fields(inspect.type_info(each)) for each in ACTIONS.own.values()]
        return st.builds(_intent, fields, st.one_of(actions))
    if issubclass(kind, PolicyActions):
        return st.builds(_policy_actions, fields, st.integers(1, 3), st.integers(0, 3))
    if issubclass(kind, ServoState | ServoCommand):
        return st.builds(_servos, st.just(kind), fields, st.integers(0, 9))
    return fields


def numbers_in(data: Any, path: Path = ()) -> Iterator[Path]:
    """The paths of all floating point numbers."""
    if isinstance(data, float):
        yield path
    for key, value in _children(data):
        yield from numbers_in(value, (*path, key))


def leaves_in(data: Any, path: Path = ()) -> Iterator[Path]:
    """The paths of all values that are neither map nor list."""
    children = list(_children(data))
    if path and not children:
        yield path
    for key, value in children:
        yield from leaves_in(value, (*path, key))


def replaced(data: Any, path: Path, value: Any) -> Any:
    """A copy with another value at one path."""
    if not path:
        return value
    if isinstance(data, dict):
        return data | {path[0]: replaced(data[path[0]], path[1:], value)}
    index = path[0]
    assert isinstance(index, int)
    return [*data[:index], replaced(data[index], path[1:], value), *data[index + 1 :]]


def _children(data: Any) -> list[tuple[str | int, Any]]:
    if isinstance(data, dict):
        return list(data.items())
    return list(enumerate(data)) if isinstance(data, list) else []


def _intent(fields: Data, action: Data) -> Data:
    return fields | {"action": action}


def _frame(fields: Data, width: int, height: int) -> Data:
    pixels = width * height
    return fields | {"width": width, "height": height, "colour": bytes(3 * pixels), "depth": bytes(2 * pixels)}


def _floor_plan(fields: Data, width: int, height: int) -> Data:
    return fields | {"width": width, "height": height, "cells": bytes(width * height)}


def _policy_actions(fields: Data, rows: int, joints: int) -> Data:
    base = {name: [(fields.get(name) or [0.5])[0]] * rows for name in ("ahead_mps", "turn_radps", "aside_mps")}
    names = [f"joint_{number}" for number in range(joints)]
    return fields | base | {"joints": names, "goal_rad": [[0.5] * joints] * rows, "period_s": 0.1}


def _servos(kind: type[Message], fields: Data, joints: int) -> Data:
    """Make the fields per joint as long as `joints`."""
    per_joint = ("goal_rad", "speed_radps") if kind is ServoCommand else ("position_rad", "speed_radps", "load")
    names = {"joints": [f"joint_{number}" for number in range(joints)]}
    return fields | names | {name: [(fields[name] or [0.5])[0]] * joints for name in per_joint}


def _fields(kind: inspect.Type) -> st.SearchStrategy[Any]:
    match kind:
        case inspect.StructType(fields=fields):
            required = {field.encode_name: _fields(field.type) for field in fields if field.required}
            optional = {field.encode_name: _fields(field.type) for field in fields if not field.required}
            own = {name: optional.pop(name) for name in ("stamp_ns", "seq", "incarnation") if name in optional}
            tag = {} if kind.tag_field is None else {kind.tag_field: st.just(kind.tag)}
            return st.fixed_dictionaries(required | own | tag, optional=optional)
        case inspect.FloatType():
            low = (
                -LARGEST if kind.ge is None and kind.gt is None else max(v for v in (kind.ge, kind.gt) if v is not None)
            )
            high = kind.le if kind.le is not None else LARGEST
            return st.floats(low, high, exclude_min=kind.gt is not None)
        case inspect.IntType():
            low_int = 0 if kind.ge is not None and kind.ge >= 0 else -(2**63)
            return st.integers(max(low_int, kind.ge or low_int), kind.le if kind.le is not None else 2**63 - 1)
        case inspect.StrType():
            return st.text(max_size=12)
        case inspect.BoolType():
            return st.booleans()
        case inspect.NoneType():
            return st.none()
        case inspect.LiteralType(values=values):
            return st.sampled_from(values)
        case inspect.BytesType() | inspect.MemoryViewType():
            return st.binary(max_size=8)
        case inspect.AnyType():
            return st.none() | st.text(max_size=4) | st.integers(0, 9)
        case inspect.UnionType(types=types):
            return st.one_of(*map(_fields, types))
        case inspect.TupleType(item_types=types):
            return st.tuples(*map(_fields, types)).map(list)
        case inspect.VarTupleType(item_type=item) | inspect.ListType(item_type=item):
            return st.lists(_fields(item), max_size=3)
        case inspect.DictType(key_type=key, value_type=value):
            return st.dictionaries(_fields(key), _fields(value), max_size=3)
    raise NotImplementedError(f"no samples of {kind}")
