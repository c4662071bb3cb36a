"""The JSON Schema that a capture has of each type, and what becomes of a capture whose types have changed since.

The rules of reading, as of every reader on the mesh (msgspec applies them to each message):

- a field that today's type does not have is passed by;
- a field that the recorded message does not have takes today's default; where there is none, the message cannot be read
  as that type, only as the map that it is;
- a field whose type or limits have changed is read where the recorded value fits today's, else as above.

An output that is compared with a recorded one (`apps.captures.reexecute`) is compared by the fields that both types
have: of a field that has come since nothing was recorded, and one that is no more is not made. What has changed is
told.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import msgspec

ENCODING = "jsonschema"


class TypeSchema(NamedTuple):
    name: str
    encoding: str
    data: bytes


@cache
def schema_of(kind: type[msgspec.Struct]) -> TypeSchema:
    """The schema of a message's type: an object at its root, binary fields as `contentEncoding: binary`."""
    whole = msgspec.json.schema(kind)
    parts = dict(whole.get("$defs", {}))
    root = parts.pop(kind.__name__, whole)
    found = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root}
    if parts:
        found["$defs"] = parts
    return TypeSchema(kind.__name__, ENCODING, json.dumps(_binary(found), separators=(",", ":")).encode())


def _binary(node: Any) -> Any:
    """MessagePack carries bytes as they are, not as text in base 64."""
    if isinstance(node, dict):
        return {
            name: "binary" if (name, value) == ("contentEncoding", "base64") else _binary(value)
            for name, value in node.items()
        }
    return [_binary(item) for item in node] if isinstance(node, list) else node


class Change(NamedTuple):
    text: str
    readable: bool
    """Whether messages of the recorded schema can still be read as today's type, by the rules above; None of a change
    of a field's type is sure, so that counts as not."""


def changes(recorded: bytes, today: bytes) -> list[Change]:
    """What is different in today's schema, in words. Empty when nothing is that a reader could notice."""
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
        yield Change(f"{where}{name} is no more: passed by", readable=True)
    for name in sorted(set(after) - set(before)):
        if name in required:
            yield Change(f"{where}{name} is new and has no default", readable=False)
        else:
            yield Change(f"{where}{name} is new: takes its default", readable=True)
    for name in sorted(set(before) & set(after)):
        if _plain(before[name]) != _plain(after[name]):
            yield Change(f"{where}{name} has changed", readable=False)


def known_to(recorded: bytes, value: Any) -> Any:
    """A message, made of maps and lists, without the fields that a recorded schema does not have; all of it, where
    that is no schema."""
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
    """Behind its references; of several, the one that may be meant."""
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


def _plain(node: Any) -> Any:
    """Without what does not bear on whether a value fits."""
    if isinstance(node, dict):
        return {name: _plain(value) for name, value in node.items() if name not in ("description", "title", "default")}
    return [_plain(item) for item in node] if isinstance(node, list) else node
