"""What the physics and the emulated firmware tell each other: datagrams over a socket pair, the newest counts.

They are processes of their own: firmware answers within a millisecond, and a frame takes the physics ten.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import socket
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import msgspec

from sim.wire.control import Control, ControlServer
from sim.wire.create import EmulatedCreate
from sim.wire.dynamixel import EmulatedServo, EmulatedServoBus, Motor
from sim.wire.emulator import Device, Emulator

S = TypeVar("S", bound=msgspec.Struct)


class ServoSetup(msgspec.Struct, array_like=True):
    number: int
    model: int
    overload_s: float
    position: int


class Setup(msgspec.Struct, array_like=True):
    """The first datagram to the firmware: which devices there are, and how they stand."""

    wheel_base_mm: float
    lines: dict[str, list[ServoSetup]]
    seed: int


class MotorOrder(msgspec.Struct, array_like=True):
    on: bool
    goal: int
    speed: int
    limit: float
    slope: int
    punch: float


class MotorOrders(msgspec.Struct, array_like=True):
    """From the firmware: what wheels and servos are to do."""

    left_mmps: int
    right_mmps: int
    motors: dict[int, MotorOrder]


class PlantState(msgspec.Struct, array_like=True):
    """From the physics: what they did."""

    time_ns: int
    left_m: float
    """Since the start."""
    right_m: float
    bump_left: bool
    bump_right: bool
    shafts: dict[int, tuple[int, int, float]]
    """Position, speed, load."""


class Channel:
    """One end of the socket pair; never blocks, and what finds no room is dropped: the next says it anew."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self.open = True

    def fileno(self) -> int:
        return self._end.fileno() if self.open else -1

    def send(self, message: msgspec.Struct) -> None:
        with suppress(BlockingIOError, ConnectionError):
            self._end.send(msgspec.msgpack.encode(message))

    def newest(self, kind: type[S]) -> S | None:
        """The last datagram that waits; None when there is none. `open` is false once the other end has closed."""
        newest = b""
        while self.open:
            try:
                data = self._end.recv(65536)
            except BlockingIOError:
                break
            except ConnectionError:
                data = b""
            if not data:
                self.open = False
            newest = data or newest
        return msgspec.msgpack.decode(newest, type=kind) if newest else None

    def close(self) -> None:
        self.open = False
        self._end.close()


class LinkedPlant:
    """The firmware's side: a body whose motions are made elsewhere."""

    def __init__(self, channel: Channel, create: EmulatedCreate, lines: Mapping[str, EmulatedServoBus]) -> None:
        self._channel = channel
        self._create = create
        self._servos = {servo.number: servo for bus in lines.values() for servo in bus.servos}
        self._rolled_m: tuple[float, float] | None = None
        self._told: MotorOrders | None = None

    def fileno(self) -> int:
        return self._channel.fileno()

    @property
    def connected(self) -> bool:
        return self._channel.open

    def advance(self, now_ns: int) -> None:
        senses = self._channel.newest(PlantState)
        if senses is not None:
            self._feel(senses)
        orders = self._orders()
        if orders != self._told:
            self._told = orders
            self._channel.send(orders)

    def _feel(self, senses: PlantState) -> None:
        rolled_m = senses.left_m, senses.right_m
        before_m = self._rolled_m or rolled_m
        self._rolled_m = rolled_m
        self._create.roll(rolled_m[0] - before_m[0], rolled_m[1] - before_m[1])
        self._create.around.bump_left = senses.bump_left
        self._create.around.bump_right = senses.bump_right
        for number, shaft in senses.shafts.items():
            self._servos[number].sense(*shaft, senses.time_ns)

    def _orders(self) -> MotorOrders:
        left, right = self._create.wheels_mmps
        motors = {number: _order(servo.motor) for number, servo in self._servos.items()}
        return MotorOrders(left, right, motors)


def _order(motor: Motor) -> MotorOrder:
    return MotorOrder(motor.on, motor.goal, motor.speed, motor.limit, motor.slope, motor.punch)


def firmware(setup: Setup) -> tuple[EmulatedCreate, dict[str, EmulatedServoBus]]:
    """The devices of a setup, as somebody left them: the Create off, the servos holding where they are."""
    lines = {}
    for name, rows in setup.lines.items():
        servos = []
        for row in rows:
            servo = EmulatedServo(row.number, row.model, row.overload_s)
            servo.put(36, row.position)
            servo.put(30, row.position)
            servo.put(24, 1)
            servos.append(servo)
        lines[name] = EmulatedServoBus(servos)
    return EmulatedCreate(setup.wheel_base_mm), lines


PREFERRED = -10


class _Ending(Emulator):
    """Ends when its body is gone."""

    linked: LinkedPlant

    def _take_jobs(self) -> bool:
        return super()._take_jobs() and self.linked.connected


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.wire.firmware", description="Emulated firmware on wires.")
    parser.add_argument("folder", type=Path, help="where the ports are to be")
    parser.add_argument("--fd", type=int, required=True, help="this process's end of a socket pair")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started it
    with suppress(PermissionError):
        os.nice(PREFERRED)  # firmware answers at once
    channel = Channel(socket.socket(fileno=options.fd))
    select.select([channel], [], [], 30.0)
    setup = channel.newest(Setup)
    if setup is None:
        return 1
    create, lines = firmware(setup)
    devices: dict[str, Device] = {"create": create, **lines}
    body = LinkedPlant(channel, create, lines)
    emulator = _Ending(options.folder, devices, body, setup.seed)
    emulator.linked = body
    with ControlServer(options.folder, Control(emulator)):
        emulator.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
