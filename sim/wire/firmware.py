"""The emulated firmware's process, and the datagrams that it exchanges with the physics.

`sim.wire.service` starts `python -m sim.wire.firmware --fd N DIR`, which ends when the other end of its socket closes.
It is a separate process because firmware answers within a millisecond, while a frame takes the physics ten.
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
from sim.wire.emulator import Device, Emulator
from sim.wire.models import servo_of
from sim.wire.servo import EmulatedServoBus, Motor

S = TypeVar("S", bound=msgspec.Struct)


class ServoSetup(msgspec.Struct, array_like=True):
    """A servo at the start."""

    number: int
    model: int
    overload_s: float
    position: int
    is_wheel: bool = False
    """Whether it is set up to turn endlessly."""


class Setup(msgspec.Struct, array_like=True):
    """The first datagram to the firmware: its devices and their state."""

    wheel_base_mm: float | None
    """Of the Create; None for a robot without one."""
    lines: dict[str, list[ServoSetup]]
    seed: int


class MotorOrder(msgspec.Struct, array_like=True):
    """`sim.wire.servo.Motor` as a message."""

    on: bool
    goal: int
    speed: int
    limit: float
    slope: int
    punch: float
    endless: int | None = None
    acceleration: int = 0


class MotorOrders(msgspec.Struct, array_like=True):
    """Commands for wheels and servos, from the firmware to the physics."""

    left_mmps: int
    right_mmps: int
    motors: dict[int, MotorOrder]


class PlantState(msgspec.Struct, array_like=True):
    """Measurements of wheels and servos, from the physics to the firmware."""

    time_ns: int
    left_m: float
    """Distance since the start."""
    right_m: float
    bump_left: bool
    bump_right: bool
    shafts: dict[int, tuple[int, int, float]]
    """By servo ID: place (counts), speed (the servo's unit) and load (share of stall torque)."""


class Channel:
    """One end of the socket pair. It never blocks: a datagram that finds no room is dropped, since the next replaces
    it."""

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
        """The newest datagram; None when none waits. `open` becomes False once the other end has closed."""
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
    """The firmware's plant: its mechanics are simulated by the physics in the other process."""

    def __init__(self, channel: Channel, create: EmulatedCreate | None, lines: Mapping[str, EmulatedServoBus]) -> None:
        self._channel = channel
        self._create = create
        self._servos = {servo.number: servo for bus in lines.values() for servo in bus.servos}
        self._rolled_m: tuple[float, float] | None = None
        self._sent: MotorOrders | None = None

    def fileno(self) -> int:
        return self._channel.fileno()

    @property
    def connected(self) -> bool:
        return self._channel.open

    def advance(self, now_ns: int) -> None:
        state = self._channel.newest(PlantState)
        if state is not None:
            self._sense(state)
        orders = self._orders()
        if orders != self._sent:
            self._sent = orders
            self._channel.send(orders)

    def _sense(self, state: PlantState) -> None:
        if self._create is not None:
            self._roll(self._create, state)
        for number, shaft in state.shafts.items():
            self._servos[number].sense(*shaft, state.time_ns)

    def _roll(self, create: EmulatedCreate, state: PlantState) -> None:
        rolled_m = state.left_m, state.right_m
        before_m = self._rolled_m or rolled_m
        self._rolled_m = rolled_m
        create.roll(rolled_m[0] - before_m[0], rolled_m[1] - before_m[1])
        create.sensors.bump_left = state.bump_left
        create.sensors.bump_right = state.bump_right

    def _orders(self) -> MotorOrders:
        left, right = (0, 0) if self._create is None else self._create.wheels_mmps
        motors = {number: order_of(servo.motor) for number, servo in self._servos.items()}
        return MotorOrders(left, right, motors)


def order_of(motor: Motor) -> MotorOrder:
    return MotorOrder(
        motor.on, motor.goal, motor.speed, motor.limit, motor.slope, motor.punch, motor.endless, motor.acceleration
    )


def firmware(setup: Setup) -> tuple[EmulatedCreate | None, dict[str, EmulatedServoBus]]:
    """Make the devices of a setup: the Create, if there is one, is off, the servos hold their positions, and those of
    wheels are limp."""
    lines = {}
    for name, rows in setup.lines.items():
        servos = []
        for row in rows:
            servo = servo_of(row.model, row.number, row.overload_s)
            servo.stand(row.position)
            servo.put(servo.AT.torque, int(not row.is_wheel))
            if row.is_wheel:
                servo.be_wheel()
            servos.append(servo)
        lines[name] = EmulatedServoBus(servos)
    return None if setup.wheel_base_mm is None else EmulatedCreate(setup.wheel_base_mm), lines


PREFERRED = -10


class _Ending(Emulator):
    """Ends when the physics has ended."""

    linked: LinkedPlant

    def _take_jobs(self) -> bool:
        return super()._take_jobs() and self.linked.connected


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.wire.firmware", description="Emulated firmware on wires.")
    parser.add_argument("folder", type=Path, help="folder for the ports")
    parser.add_argument("--fd", type=int, required=True, help="this process's end of a socket pair")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    with suppress(PermissionError):
        os.nice(PREFERRED)  # firmware must answer within a millisecond
    channel = Channel(socket.socket(fileno=options.fd))
    select.select([channel], [], [], 30.0)
    setup = channel.newest(Setup)
    if setup is None:
        return 1
    create, lines = firmware(setup)
    devices: dict[str, Device] = {**({} if create is None else {"create": create}), **lines}
    plant = LinkedPlant(channel, create, lines)
    emulator = _Ending(options.folder, devices, plant, setup.seed)
    emulator.linked = plant
    with ControlServer(options.folder, Control(emulator)):
        emulator.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
