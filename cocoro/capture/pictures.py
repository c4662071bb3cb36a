"""Frames kept with loss: the colour as JPEG, the depth as it is. Good to look at; not what perception was given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from cocoro.capture.errors import DamageError
from cocoro.capture.schema import schema_of
from cocoro.capture.writer import Entry, Prepared
from cocoro.messages import Frame, Message
from cocoro.topics import FRAME

_decoder = msgspec.msgpack.Decoder(Frame)


class LossyFrame(Message):
    """In place of a Frame on the same key, where a recorder was told to save room; stamp, sequence and incarnation are
    the frame's."""

    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour_jpeg: bytes
    depth: memoryview
    """As in Frame."""


def lossy(quality: int) -> Callable[[Entry], Prepared]:
    """Makes lossy frames of frames; everything else passes."""

    def prepare(entry: Entry) -> Prepared:
        if not entry.key.endswith(f"/{FRAME.name}"):
            return Prepared(entry, None)
        try:
            frame = _decoder.decode(entry.payload)
        except (msgspec.MsgspecError, ValueError):
            return Prepared(entry, None)
        payload = msgspec.msgpack.encode(compress(frame, quality))
        return Prepared(entry._replace(payload=payload), schema_of(LossyFrame))

    return prepare


def compress(frame: Frame, quality: int) -> LossyFrame:
    pixels = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return LossyFrame(
        stamp_ns=frame.stamp_ns,
        seq=frame.seq,
        incarnation=frame.incarnation,
        width=frame.width,
        height=frame.height,
        colour_jpeg=jpeg.tobytes(),
        depth=frame.depth,
    )


def expand(lossy: LossyFrame) -> Frame:
    """A frame that looks like the one that was recorded. Raises DamageError when the picture is none."""
    pixels = cv2.imdecode(np.frombuffer(lossy.colour_jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
    if pixels is None or pixels.shape[:2] != (lossy.height, lossy.width):
        raise DamageError("a frame's picture is damaged")
    return Frame(
        stamp_ns=lossy.stamp_ns,
        seq=lossy.seq,
        incarnation=lossy.incarnation,
        width=lossy.width,
        height=lossy.height,
        colour=memoryview(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB).tobytes()),
        depth=lossy.depth,
    )
