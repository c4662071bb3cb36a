"""Frames kept with loss: the colour as JPEG, the depth as it is. Good to look at; not what perception was given."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta

from cocoro.capture.errors import DamageError
from cocoro.messages import Frame, Message


class LossyFrame(Message):
    """In place of a Frame on the same key, where a recorder was told to save room; stamp, sequence and incarnation are
    the frame's."""

    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour_jpeg: bytes
    depth: memoryview
    """As in Frame."""


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
