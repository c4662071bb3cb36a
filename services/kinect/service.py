"""The Kinect as a service."""

from __future__ import annotations

import asyncio
from contextlib import closing

import numpy as np

from cocoro import topics
from cocoro.component import Implementation
from cocoro.messages import Frame
from cocoro.node import Node
from services.kinect.config import KinectConfig
from services.kinect.device import Shot, open_device
from services.kinect.lens import Straightener


async def run(node: Node, config: KinectConfig) -> None:
    """Publish every pair for ever. Raises ConfigError when the driver or its library is missing."""
    straighten = Straightener(node.robot)

    def tell(fault: str) -> None:
        node.faults = (fault,) if fault else ()
        if fault:
            node.log.warning("no pictures: %s", fault)
            node.degraded("no pictures")
        else:
            node.ready(f"plays {config.recording}" if config.recording else config.device)

    with closing(open_device(config, node.clock, tell)) as camera:
        async for shot in camera.shots():
            # A few milliseconds of arithmetic, which the loop does not wait for.
            straight = shot if straighten.idle else await asyncio.to_thread(straighten, shot)
            node.publish(topics.FRAME, as_frame(straight))


implementation = Implementation(KinectConfig, run)


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
