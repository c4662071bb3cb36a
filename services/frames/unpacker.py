"""The unpacker: publishes another host's frames on this one, with their own stamps and numbers, by shared memory.

Perception here cannot tell it from the camera, except by frames that are smaller or rarer when the network is slow.
"""

from __future__ import annotations

import asyncio
from typing import NoReturn

import msgspec

from cocoro.component import Implementation
from cocoro.node import Node
from cocoro.topics import FRAME
from services.frames.reader import PackedReader

TELL_S = 1.0


class UnpackerConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The unpacker has no settings: the network decides."""


async def run(node: Node, _config: UnpackerConfig) -> None:
    """Publishes for ever."""
    publisher = node.publisher(FRAME)
    reader = PackedReader(node, publisher.relay)
    node.degraded(reader.trouble)
    node.spawn(_tell(node, reader))
    await reader.run()


async def _tell(node: Node, reader: PackedReader) -> NoReturn:
    """Keeps the node's state: what arrives, or why nothing does."""
    frames, octets = 0, 0
    while True:
        await asyncio.sleep(TELL_S)
        rate_hz, speed = (reader.frames - frames) / TELL_S, (reader.octets - octets) / TELL_S
        frames, octets = reader.frames, reader.octets
        divisor, quality = reader.pace.level
        if rate_hz:
            smaller = f"1/{divisor} of their sides, " if divisor > 1 else ""
            node.ready(f"{rate_hz:.0f} frames/s, {speed / 1e6:.2f} MB/s, {smaller}quality {quality}")
        else:
            node.degraded(f"no frames: {reader.trouble or 'the packer is silent'}")


implementation = Implementation(UnpackerConfig, run)
