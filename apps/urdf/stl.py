"""The bounds of an STL file's triangles, binary or text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from cocoro.arrays import FloatArray

_HEADER, _TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_FARTHEST = 1e6
"""Of a corner's coordinates, in the file's unit."""
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def bounds(path: Path) -> tuple[FloatArray, FloatArray]:
    """The least and the greatest corner, (3,) each, in the file's unit. Raises ValueError (without the path) for what
    is no STL with triangles, OSError for what cannot be read."""
    data = path.read_bytes()
    corners = _binary(data) if _is_binary(data) else _text(data)
    if not len(corners) or not np.isfinite(corners).all() or np.abs(corners).max() > _FARTHEST:
        raise ValueError("is no STL with triangles")
    return corners.min(axis=0), corners.max(axis=0)


def _is_binary(data: bytes) -> bool:
    """By its length, which the count of triangles gives: binary files may begin with `solid`, too."""
    return len(data) >= _HEADER and len(data) == _HEADER + _TRIANGLE.itemsize * int.from_bytes(data[80:84], "little")


def _binary(data: bytes) -> FloatArray:
    return np.frombuffer(data, _TRIANGLE, offset=_HEADER)["corners"].reshape(-1, 3).astype(np.float64)


def _text(data: bytes) -> FloatArray:
    return np.array([[float(value) for value in corner] for corner in _VERTEX.findall(data)]).reshape(-1, 3)
