"""Packs a frame for a network, and unpacks it: colour as JPEG, depth exactly.

The codes of depth are constant along most of a surface (11 bits, half a hundred of them in a room), so zstd at its
fastest level takes them as they are. Prediction by the row or the plane before it, and PNG, were measured: they take
longer and save at most 12 % (docs/sites.md, "Networks").
"""

from __future__ import annotations

import cv2
import numpy as np
import zstandard

from cocoro.messages import Frame, PackedFrame

DEPTH_LEVEL = 1
"""Of zstd."""
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""The markers of a JPEG file that are followed by its size."""


def pack(frame: Frame, divisor: int = 1, quality: int = 90) -> PackedFrame:
    """The packed frame, with sides divided by `divisor`: colours are averaged, of depth every n-th code is kept.

    A frame whose sides are no multiples of the divisor stays as large as it is.
    """
    colour = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
    depth = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width) if frame.has_depth else None
    if divisor > 1 and frame.width % divisor == 0 and frame.height % divisor == 0:
        size = frame.width // divisor, frame.height // divisor
        colour = np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if depth is not None:
            depth = np.ascontiguousarray(depth[divisor // 2 :: divisor, divisor // 2 :: divisor])
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(colour, cv2.COLOR_RGB2BGR), options)
    height, width = colour.shape[:2]
    return PackedFrame(
        stamp_ns=frame.stamp_ns,
        seq=frame.seq,
        incarnation=frame.incarnation,
        width=width,
        height=height,
        colour=jpeg.tobytes(),
        depth=b"" if depth is None else zstandard.ZstdCompressor(level=DEPTH_LEVEL).compress(depth.tobytes()),
    )


def unpack(packed: PackedFrame) -> Frame:
    """The frame, with the packed one's stamp and numbers. Raises ValueError with the reason when the picture or the
    depth is damaged or has another size than the message says; nothing larger than that is ever decoded."""
    size = _jpeg_size(packed.colour)
    if size != (packed.width, packed.height):
        raise ValueError(f"colour: {_said(size)}, not {packed.width} x {packed.height}")
    bgr = cv2.imdecode(np.frombuffer(packed.colour, dtype=np.uint8), cv2.IMREAD_COLOR)
    if bgr is None or bgr.shape != (packed.height, packed.width, 3):
        raise ValueError("colour: OpenCV cannot decode it")
    colour = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    depth = _unpacked_depth(packed.depth, 2 * packed.width * packed.height) if packed.depth else b""
    return Frame(
        stamp_ns=packed.stamp_ns,
        seq=packed.seq,
        incarnation=packed.incarnation,
        width=packed.width,
        height=packed.height,
        colour=colour.reshape(-1).data,
        depth=memoryview(depth),
    )


def _unpacked_depth(data: bytes, expected: int) -> bytes:
    try:
        told = zstandard.get_frame_parameters(data).content_size
        if told != expected:
            raise ValueError(f"depth: {told} bytes, {expected} are expected")
        depth = zstandard.ZstdDecompressor().decompress(data, max_output_size=expected)
    except zstandard.ZstdError as error:
        raise ValueError(f"depth: {error}") from error
    if len(depth) != expected:
        raise ValueError(f"depth: {len(depth)} bytes, {expected} are expected")
    return depth


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height by the header of a JPEG file; None when it has none."""
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _START_OF_FRAME:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _said(size: tuple[int, int] | None) -> str:
    return "no JPEG picture" if size is None else f"{size[0]} x {size[1]}"
