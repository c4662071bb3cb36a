"""Tasks described as data: what a program needs that offers them, without their types."""

from __future__ import annotations

import inspect
from typing import Any

import msgspec
from msgspec import NODEFAULT
from msgspec.inspect import BoolType, FloatType, IntType, Metadata, StrType, Type, UnionType, type_info

from cocoro.messages.executive import OptionType, TaskKind, TaskOption
from cocoro.tasks import Task


def described(kind: type[Task]) -> TaskKind:
    """One task with its options; a label that names no object is one. An option of another type than text, number or
    yes and no is left out; so is one that the command line does not have either."""
    fields = msgspec.structs.fields(kind)
    labels = [field for field in fields if field.name == "label" and kind.needs_label]
    options = [_option(field) for field in fields if field not in labels]
    return TaskKind(
        name=kind.tag(),
        doc=inspect.cleandoc(kind.__doc__ or "").partition("\n\n")[0].replace("\n", " "),
        label=kind.needs_label,
        label_needed=bool(labels) and labels[0].default is NODEFAULT,
        samples=kind.samples is not None,
        options=tuple(option for option in options if option is not None),
    )


def _option(field: msgspec.structs.FieldInfo) -> TaskOption | None:
    plain, extra, schema = _unwrapped(type_info(field.type))
    name = _name(plain)
    if name is None or not extra.get("option", True):
        return None
    low, high = (None, None) if not isinstance(plain, IntType | FloatType) else (plain.ge, plain.le)
    if isinstance(plain, IntType | FloatType):
        low, high = (plain.gt if low is None else low), (plain.lt if high is None else high)
    return TaskOption(
        name=field.name,
        type=name,
        default=None if field.default is NODEFAULT else msgspec.to_builtins(field.default),
        needed=field.default is NODEFAULT and field.default_factory is NODEFAULT,
        description=str(schema.get("description", "")),
        min=low,
        max=high,
    )


def _name(kind: Type) -> OptionType | None:
    if isinstance(kind, BoolType):
        return "bool"
    if isinstance(kind, IntType):
        return "int"
    if isinstance(kind, FloatType):
        return "float"
    return "str" if isinstance(kind, StrType) else None


def _unwrapped(kind: Type) -> tuple[Type, dict[str, Any], dict[str, Any]]:
    """The type behind `Annotated` and `| None`, with its notes."""
    extra: dict[str, Any] = {}
    schema: dict[str, Any] = {}
    while isinstance(kind, Metadata | UnionType):
        if isinstance(kind, Metadata):
            extra |= kind.extra or {}
            schema |= kind.extra_json_schema or {}
            kind = kind.type
        else:
            others = [one for one in kind.types if not isinstance(one, msgspec.inspect.NoneType)]
            if len(others) != 1:
                break
            kind = others[0]
    return kind, extra, schema
