"""Runs emulated devices behind serial ports, by CLOCK_MONOTONIC, in one thread."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from math import copysign
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Protocol, TypeVar

from cocoro.clock import NS
from sim.wire.create import EmulatedCreate
from sim.wire.line import Disturbance, LineFault, PseudoSerialPort
from sim.wire.servo import EmulatedServo, EmulatedServoBus, Motor

T = TypeVar("T")

TURN_S = 0.004
"""Longest time between two turns of the loop."""


class Device(Protocol):
    """A device at the end of a line."""

    def receive(self, data: bytes, baud: int, now_ns: int) -> None: ...

    def advance(self, baud: int, now_ns: int) -> bytes:
        """The bytes that a listener at this baud rate has received by now."""


class Plant(Protocol):
    """The mechanics behind the devices: moved by their motors, and measured by their sensors."""

    def advance(self, now_ns: int) -> None: ...

    def fileno(self) -> int:
        """A descriptor that becomes readable when `advance` should be called; -1 for none."""


class Line:
    """A port, the device behind it, and the disturbances of the bytes in between."""

    def __init__(self, path: Path, device: Device, seed: int = 0) -> None:
        self.port = PseudoSerialPort(path)
        self.device = device
        self._to_device = Disturbance("to_device", seed)
        self._to_driver = Disturbance("to_driver", seed)

    def disturb(self, fault: LineFault) -> None:
        self._to_device.add(fault)
        self._to_driver.add(fault)

    def undisturb(self) -> None:
        self._to_device.clear()
        self._to_driver.clear()

    def turn(self, now_ns: int) -> None:
        """Carry bytes both ways."""
        data = self._to_device.carry(self.port.read(), now_ns)
        baud = self.port.baud
        if data:
            self.device.receive(data, baud, now_ns)
        self.port.write(self._to_driver.carry(self.device.advance(baud, now_ns), now_ns))


class Emulator:
    """Devices by name, on ports of these names in `folder`. Call `run`, or use it as a context manager, which runs it
    in a thread."""

    def __init__(self, folder: Path, devices: Mapping[str, Device], plant: Plant, seed: int = 0) -> None:
        self.lines = {
            name: Line(folder / name, device, seed + number) for number, (name, device) in enumerate(devices.items())
        }
        self._plant = plant
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._wake, self._waker = os.pipe()
        os.set_blocking(self._wake, False)
        self._thread: threading.Thread | None = None
        self._watches: list[tuple[Callable[[], object], Future[int]]] = []

    def run(self) -> None:
        """Run until `stop`."""
        try:
            while self._take_jobs():
                now_ns = time.monotonic_ns()
                self._plant.advance(now_ns)
                for line in self.lines.values():
                    line.turn(now_ns)
                self._watch(now_ns)
                self._rest()
        finally:
            for line in self.lines.values():
                line.port.close()

    def stop(self) -> None:
        """End `run`. Thread-safe."""
        self._jobs.put(None)
        os.write(self._waker, b"!")

    def call(self, job: Callable[[], T]) -> T:
        """Run a job in the emulator's thread, between two turns, and wait for it. Returns or raises what the job
        does."""
        future: Future[T] = Future()

        def work() -> None:
            try:
                future.set_result(job())
            except BaseException as error:
                future.set_exception(error)

        self._jobs.put(work)
        os.write(self._waker, b"!")
        return future.result(10.0)

    def until(self, condition: Callable[[], object], timeout_s: float = 30.0) -> int:
        """Wait until a condition, which is evaluated in each turn, holds; returns when (CLOCK_MONOTONIC, ns). Raises
        TimeoutError when it does not hold in time."""
        future: Future[int] = Future()
        self.call(lambda: self._watches.append((condition, future)))
        try:
            return future.result(timeout_s)
        finally:
            future.cancel()

    def __enter__(self) -> Emulator:
        self._thread = threading.Thread(target=self.run, name="emulator", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join()
        os.close(self._wake)
        os.close(self._waker)

    def _watch(self, now_ns: int) -> None:
        for watch in list(self._watches):
            condition, future = watch
            if future.cancelled() or condition():
                self._watches.remove(watch)
                if future.set_running_or_notify_cancel():
                    future.set_result(now_ns)

    def _rest(self) -> None:
        """Wait for input, at most `TURN_S`."""
        waiting = [line.port.fileno() for line in self.lines.values()] + [self._plant.fileno(), self._wake]
        select.select([fd for fd in waiting if fd >= 0], [], [], TURN_S)

    def _take_jobs(self) -> bool:
        with suppress(BlockingIOError):
            os.read(self._wake, 4096)
        while not self._jobs.empty():
            job = self._jobs.get()
            if job is None:
                return False
            job()
        return True


WHEEL_MPS2 = 2.0
STEP_NS = 50_000_000


class SimplePlant:
    """A plant without physics: wheels ramp to their commanded speeds, servos turn towards their goals, and there are no
    obstacles. `blocked` servos strain and do not turn."""

    def __init__(self, create: EmulatedCreate | None = None, *buses: EmulatedServoBus) -> None:
        self.wheels_mps = [0.0, 0.0]
        self.rolled_m = [0.0, 0.0]
        self.blocked: set[int] = set()
        self._create = create
        self._shafts = [(servo, _Shaft(servo)) for bus in buses for servo in bus.servos]
        self._then_ns: int | None = None

    def turn_by_hand(self, number: int, count: int) -> None:
        """Turn a limp servo to a position, counts, as an operator would."""
        for servo, shaft in self._shafts:
            if servo.number == number and not servo.motor.on:
                shaft.count = float(count)

    def speeds(self) -> dict[int, float]:
        """By the ID of a servo that turns endlessly, its speed, the family's unit."""
        return {servo.number: shaft.speed for servo, shaft in self._shafts}

    def fileno(self) -> int:
        return -1

    def advance(self, now_ns: int) -> None:
        dt_s = 0.0 if self._then_ns is None else min(now_ns - self._then_ns, STEP_NS) / NS
        self._then_ns = now_ns
        if self._create is not None:
            self._roll(self._create, dt_s)
        for servo, shaft in self._shafts:
            shaft.turn(dt_s, servo.number in self.blocked, now_ns)

    def _roll(self, create: EmulatedCreate, dt_s: float) -> None:
        for side, wanted_mmps in enumerate(create.wheels_mmps):
            change = wanted_mmps / 1000.0 - self.wheels_mps[side]
            self.wheels_mps[side] += copysign(min(abs(change), WHEEL_MPS2 * dt_s), change)
        rolled = [speed * dt_s for speed in self.wheels_mps]
        self.rolled_m = [way + more for way, more in zip(self.rolled_m, rolled, strict=True)]
        create.roll(*rolled)


class _Shaft:
    def __init__(self, servo: EmulatedServo) -> None:
        self._servo = servo
        self._full_speed = servo.FULL_RPM / servo.SPEED_RPM
        self._counts_a_speed = servo.SPEED_RPM / 60 * servo.TURN_COUNTS
        """Position counts per second for each count of speed."""
        self.count = float(servo.shaft)
        self.speed = 0.0
        """Of a servo that turns endlessly."""

    def turn(self, dt_s: float, blocked: bool, now_ns: int) -> None:
        motor = self._servo.motor
        if motor.endless is not None:
            self._spin(motor, motor.endless, dt_s, blocked, now_ns)
            return
        self.speed = speed = load = 0.0
        error = motor.goal - self.count
        if motor.on and motor.limit > 0.0 and abs(error) >= 0.5:
            share = min(max(abs(error) / motor.slope, motor.punch), 1.0)
            load = copysign(motor.limit * share if blocked else 0.05 * motor.limit, error)
            if not blocked and dt_s > 0.0:
                fastest = min(motor.speed or self._full_speed, self._full_speed)
                step = min(abs(error), fastest * self._counts_a_speed * dt_s)
                speed = copysign(step / self._counts_a_speed / dt_s, error)
                self.count += copysign(step, error)
        self._servo.sense(round(self.count), round(speed), load, now_ns)

    def _spin(self, motor: Motor, wanted: int, dt_s: float, blocked: bool, now_ns: int) -> None:
        """Turn endlessly. One that is limp is braked by its gears, as fast as any."""
        pushes = motor.on and motor.limit > 0.0
        asked = min(max(wanted, -self._full_speed), self._full_speed) if pushes else 0.0
        change = asked - self.speed
        step = motor.acceleration * dt_s if motor.acceleration else abs(change)
        self.speed = 0.0 if blocked else self.speed + copysign(min(abs(change), step), change)
        self.count += self.speed * self._counts_a_speed * dt_s
        load = copysign(motor.limit if blocked else 0.05 * motor.limit, asked) if pushes and asked else 0.0
        self._servo.sense(round(self.count), round(self.speed), load, now_ns)
