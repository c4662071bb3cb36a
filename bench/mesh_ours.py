"""Node to Node and raw zenoh, for `bench.mesh`: the same endpoints, options, shared memory and quality of service."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import AsyncExitStack

import zenoh
from zenoh.handlers import Callback

from bench.mesh_pixels import HEIGHT, WIDTH, colour, depth
from bench.mesh_process import FRAME_BYTES, SMALL_BYTES, STAMP_BYTES, Role, Way, stamp, stamped
from cocoro.bus.base import Qos
from cocoro.bus.declared import POLICY, QOS, SharedPool
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock, steady_ns
from cocoro.lending import LendingLoop
from cocoro.messages import Frame
from cocoro.messages.perception import Detection, Detections
from cocoro.node import Node
from cocoro.publisher import encode
from cocoro.robot import Robot
from cocoro.topics import FRAME, Topic


def detections() -> Detections:
    """A message of `SMALL_BYTES`, encoded, give or take one detection."""
    each = Detection(
        label="red_can", u_px=321.5, v_px=243.25, area_px=1830, box_px=(302, 211, 341, 276), depth_m=0.83125,
        position_m=(0.79375, 0.0625, 0.1171875),
    )  # fmt: skip
    message = Detections(
        stamp_ns=1 << 60, seq=1 << 15, incarnation=1 << 47, frame_seq=7, frame_incarnation=1 << 47,
        width=WIDTH, height=HEIGHT, pan_rad=0.5, tilt_rad=0.25,
    )  # fmt: skip
    while len(encode(message)) < SMALL_BYTES - 50:
        message.detections = (*message.detections, each)
    return message


def topic_of(role: Role) -> Topic[Detections]:
    """A command, which is sent at once and whose age the reader checks, too."""
    return Topic(f"{role}/small", Detections, Qos.COMMAND, 1000.0, 1.0, "")


class LoopWay(Way):
    """What it sends, an event loop in a thread of its own sends."""

    _loop: asyncio.AbstractEventLoop

    def bounce(self, count: int) -> list[int]:
        self.tally.begin(count, echo=True)
        self._loop.call_soon_threadsafe(self.send_small)
        return self.tally.wait()

    def paced(self, count: int, hz: float, send: Callable[[], None]) -> None:
        asyncio.run_coroutine_threadsafe(_paced(count, hz, send), self._loop).result()


class NodeWay(LoopWay):
    """What services use: typed messages, stamped, numbered, encoded; decoded, checked and counted by the reader."""

    def open(self) -> None:
        self._loop = LendingLoop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        asyncio.run_coroutine_threadsafe(self._enter(), self._loop).result()

    async def _enter(self) -> None:
        self._stack = AsyncExitStack()
        bus = await self._stack.enter_async_context(
            await ZenohBus.open(ZenohConfig(self.role, directory=self.folder / "mesh", shared_memory=True))
        )
        self._clock = RealClock(0)
        self._node = node = await self._stack.enter_async_context(
            Node(self.role, bus, self._clock, Robot.load(), robot_name="bench")
        )
        self._small = node.publisher(topic_of(self.role))
        self._message = detections()
        if self.role == "a":
            self._frames = node.publisher(FRAME)
        else:
            node.on(FRAME, self._arrive)
        node.on(topic_of(self.other), self._arrive)
        node.ready()

    def _arrive(self, message: Detections | Frame) -> None:
        self.tally.arrived(self._clock.now_ns() - message.stamp_ns)

    def send_small(self) -> None:
        self._message.stamp_ns = 0
        self._small.put(self._message)

    def send_frame(self) -> None:
        now_ns = self._clock.now_ns()
        frame = Frame(width=WIDTH, height=HEIGHT, colour=colour.data, depth=depth.data)
        self._frames.put(frame, now_ns)

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._stack.aclose(), self._loop).result()


async def _paced(count: int, hz: float, send: Callable[[], None]) -> None:
    loop = asyncio.get_running_loop()
    begin_s = loop.time()
    for number in range(count):
        await asyncio.sleep(max(0.0, begin_s + number / hz - loop.time()))
        send()


class RawWay(Way):
    """Zenoh's own publishers and callbacks, on a session that the bus has opened; the callback, in zenoh's thread, is
    the end of the way."""

    def open(self) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        config = ZenohConfig(self.role, directory=self.folder / "mesh", shared_memory=True)
        self._bus = asyncio.run_coroutine_threadsafe(ZenohBus.open(config), self._loop).result()
        session = self._bus._session
        self._small = session.declare_publisher(f"raw/{self.role}/small", **QOS[Qos.COMMAND])
        self._data = bytes(SMALL_BYTES - STAMP_BYTES)
        if self.role == "a":
            self._frames = session.declare_publisher("raw/frame", **QOS[Qos.FRAME])
            self._provider = SharedPool()._provider
        self._subscribers = [
            session.declare_subscriber(key, Callback(self._callback, indirect=False))
            for key in (f"raw/{self.other}/small", "raw/frame")
        ]

    def _callback(self, sample: zenoh.Sample) -> None:
        data = sample.payload.to_bytes()
        self.tally.arrived(steady_ns() - stamp(data))

    def send_small(self) -> None:
        self._small.put(stamped(self._data))

    def send_frame(self) -> None:
        now_ns = steady_ns()
        assert self._provider is not None
        buffer = self._provider.alloc(STAMP_BYTES + FRAME_BYTES, POLICY)
        buffer[:STAMP_BYTES] = now_ns.to_bytes(STAMP_BYTES, "little")
        at = STAMP_BYTES
        for pixels in (colour, depth):  # zenoh takes bytes, no other buffer
            buffer[at : at + pixels.nbytes] = pixels.tobytes()
            at += pixels.nbytes
        self._frames.put(zenoh.ZBytes(buffer))

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._bus.close(), self._loop).result()


class RawLoopWay(LoopWay, RawWay):
    """The same for a program with an event loop: the callback hands each sample to the loop."""

    def _callback(self, sample: zenoh.Sample) -> None:
        self._loop.call_soon_threadsafe(self._arrive, sample)

    def _arrive(self, sample: zenoh.Sample) -> None:
        super()._callback(sample)
