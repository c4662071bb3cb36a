"""Former shapes of messages: how a capture of an earlier version is read.

A type that was renamed, or whose recorded messages today's type cannot decode, has a rule here. The rules apply
wherever a capture's messages are read as today's types, in re-execution, exports and replays:

- a `BaseCommand` with the speeds of a Calliope's two wheels becomes one with the body's;
- a recorded schema `Clock` is today's `ClockTick`;
- an `Intent` that has its action's name in `behaviour`, and the fields of all actions beside it, becomes one that has
  an `action` with the fields of that action alone;
- an `Exchange` of `executive/run` whose question has its task's name in `task`, and the fields of all tasks beside it,
  becomes one whose question has a `task` with the fields of that task alone, and `timeout_s`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

RENAMED = {"Clock": "ClockTick"}
"""Today's name of a type, by its name in recorded schemas."""

_INTENT_FIELDS = ("stamp_ns", "seq", "incarnation", "task_id", "step")
_WHEELS_M = 0.261
"""Distance of a Calliope's wheels, by its description: whatever was recorded with wheel speeds was one."""
_ACTION_FIELDS: Mapping[str, Mapping[str, Any]] = {
    **{key: {"label": ""} for key in ("search", "explore", "approach", "reach", "grasp", "lift", "follow", "touch")},
    "carry": {"label": "", "place_m": [0.0, 0.0]},
    "go-to": {"label": "", "distance_m": 0.0},
    "babble-arm": {"first": 0, "count": 0},
    "babble-wheels": {"label": "", "first": 0, "count": 0},
}
"""The fields of a former intent for each action, with their defaults."""
_TASK_FIELDS: Mapping[str, Mapping[str, Any]] = {
    "fetch": {"label": "", "bring": False},
    "follow": {"label": "", "for_s": None},
    "touch": {"label": ""},
    "go-to": {"label": "", "distance_m": 0.2},
    "babble-arm": {"first": 0, "count": 1000},
    "babble-wheels": {"label": "", "first": 0, "count": 1000},
}
"""The fields of a former request for each task, with their defaults."""


def todays_name(schema: str) -> str:
    """Today's name of the type of a recorded schema."""
    return RENAMED.get(schema, schema)


def todays_payload(kind: str, payload: bytes | memoryview) -> bytes | memoryview:
    """A recorded payload in today's shape of its type `kind` (today's name); as it is where no rule applies."""
    convert = _RULES.get(kind)
    if convert is None:
        return payload
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return payload
    changed = convert(message) if isinstance(message, dict) else None
    return payload if changed is None else msgspec.msgpack.encode(changed)


def is_former(schema: str, data: bytes) -> bool:
    """Whether a recorded schema is of a shape that a rule converts."""
    try:
        properties = json.loads(data).get("properties", {})
    except (ValueError, AttributeError):
        return False
    former = {"Intent": "behaviour", "BaseCommand": "left_mps"}
    return former.get(schema) in properties


def _intent(message: dict[str, Any]) -> dict[str, Any] | None:
    name = message.get("behaviour")
    if "action" in message or not isinstance(name, str):
        return None
    kept: dict[str, Any] = {field: value for field, value in message.items() if field in _INTENT_FIELDS}
    kept["action"] = {"action": name, **_fields(message, _ACTION_FIELDS.get(name, {}))}
    return kept


def _base_command(message: dict[str, Any]) -> dict[str, Any] | None:
    left, right = message.get("left_mps"), message.get("right_mps")
    if not isinstance(left, int | float) or not isinstance(right, int | float):
        return None
    kept = {field: value for field, value in message.items() if field not in ("left_mps", "right_mps")}
    return {**kept, "ahead_mps": (left + right) / 2, "turn_radps": (right - left) / _WHEELS_M}


def _exchange(message: dict[str, Any]) -> dict[str, Any] | None:
    question = message.get("question")
    if message.get("request") != "executive/run" or not isinstance(question, dict):
        return None
    name = question.get("task")
    if not isinstance(name, str):
        return None
    task = {"task": name, **_fields(question, _TASK_FIELDS.get(name, {}))}
    return {**message, "question": {"task": task, "timeout_s": question.get("timeout_s")}}


def _fields(message: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    found = {field: message.get(field, default) for field, default in defaults.items()}
    return {field: defaults[field] if value is None else value for field, value in found.items()}


_RULES: Mapping[str, Callable[[dict[str, Any]], dict[str, Any] | None]] = {
    "BaseCommand": _base_command,
    "Intent": _intent,
    "Exchange": _exchange,
}
"""By today's name of a type, what makes today's message of a former one; None of one that is of today."""
