"""Makes lossy frames (see `cocoro.capture.pictures`) of the frames that are recorded."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import msgspec
import numpy as np

from cocoro.capture.pictures import LossyFrame
from cocoro.capture.schema import schema_of
from cocoro.messages import Frame
from cocoro.topics import FRAME
from services.capture.writer import Entry, Prepared

_decoder = msgspec.msgpack.Decoder(Frame)


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
