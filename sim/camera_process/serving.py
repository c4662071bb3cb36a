"""What runs in the camera's process."""

from __future__ import annotations

import logging
import mmap
import os
import socket
from typing import NamedTuple

import msgspec

from cocoro.errors import CocoroError
from cocoro.robot import Robot
from cocoro.units import Vec3
from sim.camera import SimKinect
from sim.camera_process.wire import MESSAGE_BYTES, Exposure, Setup, Taken, slots_of
from sim.render import make_renderer, prepare


class _Light(NamedTuple):
    """See `sim.render.Lighting`."""

    ambient: float
    diffuse: float
    direction: Vec3
    temperature_k: float


class _Kept(logging.Handler):
    """Keeps the log for the next answer."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self._texts.append(record.getMessage())

    def take(self) -> tuple[str, ...]:
        texts, self._texts = tuple(self._texts), []
        return texts


def serve(channel: socket.socket) -> None:
    """Take pictures until the owner's end closes. Raises ConnectionError when it closed early."""
    kept = _Kept()
    logging.getLogger().handlers[:] = [kept]
    # Mesa's software renderer starts a thread for each core, but of two cores the owner needs one.
    os.environ.setdefault("LP_NUM_THREADS", str(max((os.cpu_count() or 1) - 2, 0)))
    prepare()
    message, memory, _, _ = socket.recv_fds(channel, MESSAGE_BYTES, 1)
    if message:
        setup = msgspec.msgpack.decode(message, type=Setup)
        _serve(channel, setup, mmap.mmap(memory[0], 0), kept)


def _serve(channel: socket.socket, setup: Setup, memory: mmap.mmap, kept: _Kept) -> None:
    """Take pictures until the owner's end closes."""
    slots = slots_of(memory, setup)
    try:
        kinect = _kinect(setup)
    except CocoroError as error:
        channel.send(msgspec.msgpack.encode(Taken(0, kept.take(), str(error))))
        return
    decoder = msgspec.msgpack.Decoder(Exposure)
    while message := channel.recv(MESSAGE_BYTES):
        asked = decoder.decode(message)
        slot = slots[asked.slot]
        light = _Light(asked.ambient, asked.diffuse, asked.direction, asked.temperature_k)
        frame = kinect.capture(slot.poses, slot.camera_pose, asked.stamp_ns, light)
        slot.colour.data[:] = frame.colour
        if frame.has_depth:
            slot.depth.data[:] = frame.depth
        channel.send(msgspec.msgpack.encode(Taken(asked.slot, kept.take())))


def _kinect(setup: Setup) -> SimKinect:
    robot = Robot.from_data(setup.robot)
    renderer = make_renderer(setup.visuals, robot.camera.scaled(setup.width, setup.height), setup.renderer)
    return SimKinect(
        robot, renderer, sensors=setup.sensors, seed=setup.seed, width=setup.width, height=setup.height
    )  # fmt: skip
