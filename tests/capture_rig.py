"""Makes captures for tests: on a local bus in virtual time, by the recorder itself."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.capture.reader import Capture, Record
from cocoro.clock import NS, VirtualClock
from cocoro.component import load
from cocoro.messages import BaseState, Frame
from cocoro.robot import Robot
from cocoro.vloop import run_virtual
from deploy.delayed import DelayedNode
from deploy.processes import named
from services.capture.keys import KeyInfo, QueuedMessage, info_of
from services.capture.packing import Compression, Packer
from services.capture.writer import CaptureWriter, FileLimits

ROBOT = Robot.load()
STILL: dict[str, Any] = {"odometry_yaw_rad": 0.0, "speed_mps": 0.0, "turn_rate_radps": 0.0}

FOR_EVER = FileLimits()

Scenario = Callable[["Room"], Awaitable[None]]


class Room:
    """A mesh with a recorder."""

    def __init__(self) -> None:
        self.mesh = LocalMesh()
        self.clock = VirtualClock()

    def node(self, name: str, **options: Any) -> DelayedNode:
        return DelayedNode(name, self.mesh.join(), self.clock, ROBOT, **options)

    async def recorded(self, settings: dict[str, Any], scenario: Scenario) -> None:
        """Play a scenario while a recorder with these settings runs."""
        component = load(named("capture"))
        config = msgspec.convert(settings, component.config)
        node = self.node("capture", module=named("capture").module, config=config)
        async with node:
            recording = asyncio.ensure_future(component.run(node, config))
            await asyncio.sleep(0.001)
            try:
                await scenario(self)
                await asyncio.sleep(0.001)
            finally:
                recording.cancel()
                await asyncio.gather(recording, return_exceptions=True)


def record(path: Path, scenario: Scenario, **settings: Any) -> Path:
    """Record a scenario into one file."""
    room = Room()
    run_virtual(room.recorded({"file": str(path), **settings}, scenario))
    return path


async def drive(room: Room, seconds: float = 2.0, frames: bool = True) -> None:
    """A robot that drives in a circle and sees noise: 50 states and 10 small frames a second."""
    async with room.node("base") as base, room.node("kinect") as kinect:
        base.ready()
        kinect.ready()
        for tick in range(round(seconds * 50)):
            base.publish(topics.BASE_STATE, BaseState(odometry_m=(tick / 50, 0.0), **STILL))
            if frames and tick % 5 == 0:
                kinect.publish(topics.FRAME, frame(tick))
            await asyncio.sleep(0.02)


def frame(number: int, width: int = 16, height: int = 12) -> Frame:
    shade = bytes((number + place) % 251 for place in range(3 * width * height))
    return Frame(width=width, height=height, colour=memoryview(shade), depth=memoryview(shade[: 2 * width * height]))


def writer(
    folder: Path, limits: FileLimits = FOR_EVER, compression: Compression = "zstd", **options: Any
) -> CaptureWriter:
    """Writes one-1.mcap, one-2.mcap and so on."""

    def info(key: str, payload: bytes) -> KeyInfo:
        return info_of(key, "calliope", payload)

    return CaptureWriter(lambda number: folder / f"one-{number}.mcap", Packer(compression), limits, info, **options)


def entry(key: str, number: int, payload: bytes = b"", log_ns: int | None = None) -> QueuedMessage:
    """The nth message of a key; they are 10 ms apart."""
    at_ns = NS + number * NS // 100 if log_ns is None else log_ns
    return QueuedMessage(f"calliope/{key}", number, at_ns, at_ns - 1000, payload or state(number))


def state(number: int) -> bytes:
    return msgspec.msgpack.encode(BaseState(seq=number, odometry_m=(float(number), 0.0), **STILL))


def all_of(path: Path, *keys: str) -> list[Record]:
    """Every record, with a copy of its payload."""
    with Capture.open(path) as capture:
        return [record._replace(payload=memoryview(bytes(record.payload))) for record in capture.messages(*keys)]
