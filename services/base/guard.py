"""The guard: the only process that has the Create's serial port open.

A Create keeps driving when its driver dies. So this small process below the base service decides whether the wheels may
turn. It forwards the wheel speeds that the service asks for, and stops the wheels

- 0.2 s after the last request of the service (it hangs, was stopped or is overloaded),
- immediately when the service's end of the socket closes (it crashed or was killed),
- immediately on SIGTERM and on any error of its own,
- immediately on a stop request to its own address of the stop path, `ROBOT/wheels` (`cocoro.stop.path`),
- by the reflexes of `services.base.guard_logic`: bumpers, cliffs, wheel drops, a Create that left its mode.

`services.base.guard_supervisor` starts it.

    python -m services.base.guard PORT --fd N --robot NAME --mode safe --deadman-ms 200

`--fd` is its end of a SOCK_SEQPACKET pair. It receives {"left": mm/s, "right": mm/s, "until": ns, "reset": number of
emergency stops that have been reset} and {"recover": true}. It sends a report for each frame, and 20 a second without
frames (`GuardReport` in `services.base.driver`). Times are CLOCK_MONOTONIC, which all processes of a machine share. It
imports only the standard library, this project's stop path and pyserial (`cocoro.guard_process`).
"""

from __future__ import annotations

import argparse
import errno
import os
import select
import socket
import sys
import termios
import time
from contextlib import suppress
from typing import Any

import serial

from cocoro.guard_process import QUIET_NS, TURN_S, GuardProcess, add_arguments, run
from cocoro.stop.path import StopPoint
from services.base import oi
from services.base.guard_logic import MS, GuardLogic

REOPEN_NS = 200 * MS
STOPPING_NS = 1000 * MS
"""Upper bound for the time in which it waits for the wheels to stand before it ends."""
SENTENCES = {
    errno.ENOENT: "there is no such port: is the adapter plugged in?",
    errno.EACCES: "no permission: add the user to the group dialout, and log in again",
    errno.EAGAIN: "another program has it open",
    errno.EWOULDBLOCK: "another program has it open",
    errno.EIO: "the adapter does not answer: is it plugged in?",
}


class Guard(GuardProcess):
    """Runs one port by one `GuardLogic`."""

    def __init__(self, path: str, logic: GuardLogic, channel: socket.socket, point: StopPoint | None = None) -> None:
        super().__init__(channel, point)
        self._path = path
        self._logic = logic
        self._port: serial.Serial | None = None
        self._why = "not opened yet"
        self._reported_ns = 0
        self._tried_ns = -REOPEN_NS

    def turn(self) -> bool:
        """Handle what has arrived, and write what is due. False when the service is gone."""
        if self._port is None:
            self._open()
        descriptors = [one for one in (self._channel, self._port, self._point) if one is not None]
        readable, _, _ = select.select(descriptors, [], [], TURN_S)
        stops = self._take_stops() if self._point in readable else []
        if self._channel in readable and not self._take_messages():
            return False
        now_ns = time.monotonic_ns()
        if self._port is not None:
            try:
                if self._port in readable:
                    self._take_bytes(self._port, now_ns)
                self._write(self._port, self._logic.poll(now_ns))
            except OSError as error:  # pyserial's errors derive from it
                self._lose(_sentence(error, self._path))
        for asked in stops:
            self._answer(asked, now_ns)
        if now_ns - self._reported_ns > QUIET_NS:
            self._report(now_ns)
        return True

    def stop(self) -> None:
        """Stop the wheels, and close the port when a frame confirms that they stand, or after `STOPPING_NS`."""
        if self._port is None:
            return
        began_ns = now_ns = time.monotonic_ns()
        self._logic.end(began_ns)
        with suppress(OSError):
            while now_ns < began_ns + STOPPING_NS and not self._logic.stands:
                self._write(self._port, self._logic.poll(now_ns))
                readable = select.select([self._port], [], [], TURN_S)[0]
                now_ns = time.monotonic_ns()
                if readable:
                    self._logic.receive(os.read(self._port.fileno(), 4096), now_ns)
            self._port.flush()
        with suppress(OSError):
            self._port.close()

    def _open(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns - self._tried_ns < REOPEN_NS:
            return
        self._tried_ns = now_ns
        try:
            port = serial.Serial(self._path, oi.BAUD, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            self._why = _sentence(error, self._path)
            return
        self._port = port
        self._why = ""
        self._logic.opened(now_ns)

    def _lose(self, why: str) -> None:
        if self._port is not None:
            with suppress(OSError):
                self._port.close()
        self._port = None
        self._why = why
        self._logic.closed()

    def _take_bytes(self, port: serial.Serial, now_ns: int) -> None:
        data = os.read(port.fileno(), 4096)
        if not data:
            raise OSError(errno.EIO, "end of file")
        for readings in self._logic.receive(data, now_ns):
            self._report(now_ns, readings)

    def _write(self, port: serial.Serial, data: bytes) -> None:
        """Write without waiting. Bytes that the line does not accept now are dropped, since they would be late."""
        if data:
            with suppress(BlockingIOError):
                os.write(port.fileno(), data)

    def _stopped(self) -> None:
        self._logic.stop()

    def _obey(self, message: dict[str, Any]) -> None:
        now_ns = time.monotonic_ns()
        if "until" in message:
            self._logic.reset(int(message.get("reset", 0)))
            self._logic.ask(int(message["left"]), int(message["right"]), int(message["until"]), now_ns)
        elif message.get("recover"):
            self._logic.recover(now_ns)

    def _report(self, now_ns: int, readings: oi.Readings | None = None) -> None:
        self._reported_ns = now_ns
        wheels = self._logic.wheels
        report = {
            "t": now_ns,
            "link": self._logic.link,
            "why": self._why or self._logic.allowed(now_ns).why,
            "left": wheels.left_mmps,
            "right": wheels.right_mmps,
            "stops": self._logic.stops,
            "damage": self._logic.damage,
            "readings": readings,
            "counts_lost": self._logic.take_counts_lost() if readings is not None else False,
        }
        self._send(report)


def _sentence(error: Exception, path: str) -> str:
    number: int = getattr(error, "errno", None) or 0
    what = SENTENCES.get(number) or (os.strerror(number) if number else str(error))
    return f"{path}: {what}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m services.base.guard", description="Own a Create's serial port.")
    add_arguments(parser)
    parser.add_argument("--mode", choices=("safe", "full"), default="safe")
    parser.add_argument("--deadman-ms", type=int, default=200)
    options = parser.parse_args()

    def make(channel: socket.socket, point: StopPoint | None) -> Guard:
        return Guard(options.port, GuardLogic(options.mode, options.deadman_ms * MS), channel, point)

    return run(options, make)


if __name__ == "__main__":
    sys.exit(main())
