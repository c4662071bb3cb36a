"""Writes a tiny ONNX file by hand: `action = observation.state + offset`, as Protocol Buffers (onnx.proto)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cocoro.features import ACTION, STATE

FLOAT, IR_VERSION, OPSET = 1, 8, 13


def write(path: Path, offset: list[float], metadata: dict[str, str], of: str = STATE) -> Path:
    """The file of a policy whose action is its state, with an offset; `of` names the input."""
    count = len(offset)
    tensor = (
        _number(1, 1) + _number(1, count) + _number(2, FLOAT) + _text(8, "offset")
        + _field(9, np.array([offset], "<f4").tobytes())
    )  # fmt: skip
    node = _text(1, of) + _text(1, "offset") + _text(2, ACTION) + _text(4, "Add")
    graph = (
        _field(1, node) + _text(2, "policy") + _field(5, tensor)
        + _field(11, _value(of, count)) + _field(12, _value(ACTION, count))
    )  # fmt: skip
    entries = b"".join(_field(14, _text(1, key) + _text(2, text)) for key, text in metadata.items())
    model = _number(1, IR_VERSION) + _field(7, graph) + _field(8, _text(1, "") + _number(2, OPSET)) + entries
    path.write_bytes(model)
    return path


def _value(name: str, count: int) -> bytes:
    sides = b"".join(_field(1, _number(1, side)) for side in (1, count))
    return _text(1, name) + _field(2, _field(1, _number(1, FLOAT) + _field(2, sides)))


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _text(field: int, text: str) -> bytes:
    return _field(field, text.encode())


def _field(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    octets = bytearray()
    while True:
        value, low = value >> 7, value & 0x7F
        octets.append(low | (0x80 if value else 0))
        if not value:
            return bytes(octets)
