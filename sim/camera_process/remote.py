"""The owner's end of the camera's process."""

from __future__ import annotations

import logging
import mmap
import os
import socket
from collections import deque
from collections.abc import Callable, Sequence
from typing import NoReturn

import msgspec

from cocoro.arrays import FloatArray
from cocoro.errors import CocoroError
from cocoro.messages import Frame
from cocoro.robot import Robot
from sim.camera_process.start import take
from sim.camera_process.wire import MESSAGE_BYTES, Exposure, Setup, Taken, memory_bytes, slots_of
from sim.kinds import Sensors
from sim.memory import keep_freed_memory
from sim.render.choice import RendererChoice
from sim.render.interface import Lighting, Visual

_log = logging.getLogger(__name__)


class RemoteKinect:
    """Takes the frames that a `SimKinect` of the same arguments takes, in another process. A context manager.

    Args:
        slots: the most frames that may have been exposed and not been delivered.

    Raises CocoroError when the process cannot be started or has ended, or when it cannot draw.
    """

    def __init__(
        self,
        robot: Robot,
        visuals: Sequence[Visual],
        *,
        sensors: Sensors,
        seed: int,
        width: int,
        height: int,
        renderer: RendererChoice,
        slots: int,
    ) -> None:
        setup = Setup(robot.to_data(), list(visuals), sensors, seed, width, height, renderer, slots)
        self._width, self._height, self._sees_depth = width, height, robot.sees_depth
        self._free = deque(range(slots))
        self._due: deque[int] = deque()
        """Slots that were exposed, in order; the first ones may have been answered."""
        self._taken: set[int] = set()
        try:
            self._started = take()
        except OSError as error:
            raise CocoroError(f"the camera's process cannot be started: {error.strerror}") from error
        keep_freed_memory()  # for the messages that carry the frames
        memory = os.memfd_create("cocoro-frames")
        try:
            os.ftruncate(memory, memory_bytes(setup))
            self._slots = slots_of(mmap.mmap(memory, 0), setup)
            socket.send_fds(self._started.channel, [msgspec.msgpack.encode(setup)], [memory])
        except OSError as error:
            self._started.end()
            raise CocoroError(f"the camera's process cannot be set up: {error.strerror}") from error
        finally:
            os.close(memory)

    def __enter__(self) -> RemoteKinect:
        return self

    def __exit__(self, *_: object) -> None:
        self._started.end()

    def expose(self, poses: FloatArray, camera_pose: FloatArray, stamp_ns: int, light: Lighting) -> Callable[[], Frame]:
        """See `SimKinect.expose`. The frame is valid until the next exposure, and must be asked for in the order of the
        exposures."""
        number = self._free.popleft()
        slot = self._slots[number]
        slot.poses[:], slot.camera_pose[:] = poses, camera_pose
        exposure = Exposure(
            number, stamp_ns, light.ambient, light.diffuse, light.direction, light.temperature_k
        )  # fmt: skip
        try:
            self._started.channel.send(msgspec.msgpack.encode(exposure))
        except OSError:
            self._fail()
        self._due.append(number)
        return lambda: self._frame(number, stamp_ns)

    def _frame(self, number: int, stamp_ns: int) -> Frame:
        while number not in self._taken:
            self._receive()
        self._taken.discard(number)
        self._free.append(number)
        slot = self._slots[number]
        return Frame(
            stamp_ns=stamp_ns, width=self._width, height=self._height, colour=slot.colour.data,
            depth=slot.depth.data if self._sees_depth else memoryview(b""),
        )  # fmt: skip

    def _receive(self) -> None:
        try:
            message = self._started.channel.recv(MESSAGE_BYTES)
        except ConnectionError:
            message = b""
        if not message:
            self._fail()
        taken = msgspec.msgpack.decode(message, type=Taken)
        for warning in taken.warnings:
            _log.warning("%s", warning)
        if taken.error:
            raise CocoroError(taken.error)
        self._taken.add(taken.slot)

    def _fail(self) -> NoReturn:
        raise CocoroError(f"the camera's process has ended (exit code {self._started.end()})")
