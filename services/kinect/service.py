"""The camera's service: publishes the frames of the Kinect or of another camera, straightened."""

from __future__ import annotations

import asyncio
from contextlib import closing

import numpy as np

from cocoro import topics
from cocoro.component import Implementation
from cocoro.faults import FaultReporter
from cocoro.messages import Frame
from cocoro.node import Node
from services.kinect.camera import open_device
from services.kinect.device import KinectConfig, RawFrame
from services.kinect.lens import Straightener


async def run(node: Node, config: KinectConfig) -> None:
    """Publish every frame for ever. Raises ConfigError when the driver or its library is missing."""
    straighten = Straightener(node.robot)
    reporter = FaultReporter(node)

    def on_fault(fault: str) -> None:
        device = f"{config.device} {config.path}" if config.device == "uvc" else config.device
        works = f"plays {config.recording}" if config.recording else device
        reporter.report((fault,) if fault else (), degraded="no pictures" if fault else "", ready=works)

    with closing(open_device(config, node.clock, on_fault)) as camera:
        async for frame in camera.frames():
            # Straightening takes a few milliseconds, so a thread does it and the event loop does not wait.
            straight = frame if straighten.idle else await asyncio.to_thread(straighten, frame)
            node.publish(topics.FRAME, to_message(straight))


implementation = Implementation(KinectConfig, run)


def to_message(frame: RawFrame) -> Frame:
    """The message of a frame. Pixels are copied only when they are not contiguous."""
    height, width = frame.colour.shape[:2]
    return Frame(
        stamp_ns=frame.stamp_ns,
        width=width,
        height=height,
        colour=np.ascontiguousarray(frame.colour).reshape(-1).data,
        depth=memoryview(b"")
        if frame.depth is None
        else np.ascontiguousarray(frame.depth, dtype="<u2").reshape(-1).view(np.uint8).data,
    )
