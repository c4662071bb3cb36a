"""The Kinect as a service."""

from __future__ import annotations

from contextlib import closing

import msgspec
import numpy as np

from cocoro import topics
from cocoro.messages import Frame
from cocoro.node import Node
from services.kinect.device import Shot, open_device

__all__ = ["Config", "run"]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str = "freenect"
    """The driver's name."""


async def run(node: Node, config: Config) -> None:
    """Publish every pair for ever."""
    with closing(open_device(config.device, node.clock)) as camera:
        node.ready(config.device)
        async for shot in camera.shots():
            node.publish(topics.FRAME, as_frame(shot))


def as_frame(shot: Shot) -> Frame:
    """The message of a pair; the pixels are not copied where they lie in order."""
    height, width = shot.depth.shape
    return Frame(
        stamp_ns=shot.stamp_ns,
        width=width,
        height=height,
        colour=np.ascontiguousarray(shot.colour).reshape(-1).data,
        depth=np.ascontiguousarray(shot.depth, dtype="<u2").reshape(-1).view(np.uint8).data,
    )
