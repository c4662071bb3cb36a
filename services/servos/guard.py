"""The guard of wheels that servos turn: a process that can stop them when the service of their line cannot.

The servo of a wheel turns on at its last speed when nothing is written to it any more: no register limits that. The
line's service, which has the port open, lets its wheels turn only while this process watches over it. It vouches for
them whenever it has written their speeds, and this process writes a stop to the same port

- when the wheels turn and the service has vouched for them no longer than `Base.patience_s` of their speed ago (it
  hangs, was stopped, is overloaded, or its line fails), until it vouches again,
- when the service's end of the socket closes (it crashed or was killed), on SIGTERM and on any error of its own: again
  and again for a while, and then the servos are made limp, too,
- on a stop request to its own address of the stop path, `ROBOT/wheels` (`cocoro.stop.path`), and whenever the service
  lets them turn before that stop was reset.

    python -m services.servos.guard PORT --fd N --robot NAME --baud 1000000 --stop HEX --limp HEX

`--stop` and `--limp` are the bytes of the packets that stop the wheels and make them limp: the guard knows no protocol.
It receives {"until": ns, "turning": bool} and {"reset": number of emergency stops that have been reset}, and sends
{"t": ns, "stops": number of emergency stops, "why": why the port does not open}, at least 20 times a second. See
`cocoro.guard_process`; it imports only the standard library.
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
import tty
from contextlib import suppress
from typing import Any

from cocoro.guard_process import QUIET_NS, TURN_S, GuardProcess, add_arguments, run
from cocoro.stop.path import StopPoint

MS = 1_000_000
AGAIN_NS = 10 * MS
"""Period at which a stop is repeated: one may be lost or meet an answer on the wire."""
STOPPING_NS = 300 * MS
"""So long the wheels are stopped when the service is gone, before they are made limp."""
LIMP_NS = 100 * MS
"""So long they are made limp, before the guard ends."""


class GuardLogic:
    """The decisions: pure. Every `now_ns` is CLOCK_MONOTONIC."""

    def __init__(self, stop: bytes, limp: bytes) -> None:
        self.stops = 0
        """Count of emergency stops."""
        self._stop = stop
        self._limp = limp
        self._reset_stops = 0
        self._turning = False
        self._until_ns = 0
        self._obeyed = True
        """Whether a stop was written since the last emergency stop, or since wheels turned in spite of it."""
        self._ended_ns: int | None = None
        self._wrote_ns = -AGAIN_NS

    def vouch(self, turning: bool, until_ns: int) -> None:
        """The service has written to the wheels, and says whether they turn; it will do so again before `until_ns`."""
        self._turning = turning
        self._until_ns = until_ns
        if turning and self.stops > self._reset_stops:
            self._obeyed = False

    def stop(self) -> None:
        """Emergency stop: the wheels stand until this stop has been reset."""
        self.stops += 1
        self._obeyed = False

    def reset(self, stops: int) -> None:
        """The operator has reset the first `stops` emergency stops."""
        self._reset_stops = min(max(stops, 0), self.stops)

    def end(self, now_ns: int) -> None:
        """The service is gone."""
        self._ended_ns = now_ns

    def ended(self, now_ns: int) -> bool:
        """Whether nothing is left to do."""
        return self._ended_ns is not None and now_ns > self._ended_ns + STOPPING_NS + LIMP_NS

    def poll(self, now_ns: int) -> bytes:
        """What to write to the port now. Call it after each input, and every few milliseconds."""
        late = self._turning and now_ns > self._until_ns
        if self._ended_ns is None and not late and self._obeyed:
            return b""
        if now_ns < self._wrote_ns + AGAIN_NS and self._obeyed:
            return b""
        self._wrote_ns, self._obeyed = now_ns, True
        if self._ended_ns is not None and now_ns > self._ended_ns + STOPPING_NS:
            return self._limp
        return self._stop


class Port:
    """A serial port that other processes have open, too. It is only written to."""

    def __init__(self, path: str, baud: int) -> None:
        self.why = ""
        """Why it cannot be written to; '' when it can."""
        self._path = path
        self._baud: int = getattr(termios, f"B{baud}")
        self._fd: int | None = None

    def write(self, data: bytes) -> None:
        """Write without waiting: what the line does not accept now would be late."""
        for _ in range(2):  # a port that was unplugged and plugged in again is another one
            if not self.open():
                return
            assert self._fd is not None
            try:
                os.write(self._fd, data)
            except BlockingIOError:
                return
            except OSError as error:
                self.why = _sentence(error, self._path)
                self.close()
            else:
                return

    def open(self) -> bool:
        """Open it, unless it is, as the service does, which may not have done so yet."""
        if self._fd is not None:
            return True
        try:
            self._fd = os.open(self._path, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._fd, termios.TCSANOW)
            settings = termios.tcgetattr(self._fd)
            settings[2] |= termios.CLOCAL
            settings[4] = settings[5] = self._baud
            termios.tcsetattr(self._fd, termios.TCSANOW, settings)
        except (OSError, termios.error) as error:
            self.why = _sentence(error, self._path)
            self.close()
            return False
        self.why = ""
        return True

    def close(self) -> None:
        if self._fd is not None:
            with suppress(OSError):
                os.close(self._fd)
            self._fd = None


class Guard(GuardProcess):
    def __init__(self, port: Port, logic: GuardLogic, channel: socket.socket, point: StopPoint | None = None) -> None:
        super().__init__(channel, point)
        self._port = port
        self._logic = logic
        self._reported_ns = 0

    def turn(self) -> bool:
        descriptors = [one for one in (self._channel, self._point) if one is not None]
        readable, _, _ = select.select(descriptors, [], [], TURN_S)
        stops = self._take_stops() if self._point in readable else []
        if self._channel in readable and not self._take_messages():
            return False
        now_ns = time.monotonic_ns()
        self._write(now_ns)
        for asked in stops:
            self._answer(asked, now_ns)
        if stops or now_ns - self._reported_ns > QUIET_NS:
            self._reported_ns = now_ns
            self._port.open()  # before it is needed: who cannot write guards nothing
            self._send({"t": now_ns, "stops": self._logic.stops, "why": self._port.why})
        return True

    def stop(self) -> None:
        now_ns = time.monotonic_ns()
        self._logic.end(now_ns)
        while not self._logic.ended(now_ns):
            self._write(now_ns)
            time.sleep(TURN_S)
            now_ns = time.monotonic_ns()
        self._port.close()

    def _write(self, now_ns: int) -> None:
        if data := self._logic.poll(now_ns):
            self._port.write(data)

    def _stopped(self) -> None:
        self._logic.stop()

    def _obey(self, message: dict[str, Any]) -> None:
        if "until" in message:
            self._logic.vouch(bool(message["turning"]), int(message["until"]))
        elif "reset" in message:
            self._logic.reset(int(message["reset"]))


def _sentence(error: Exception, path: str) -> str:
    number = error.errno if isinstance(error, OSError) and error.errno else errno.EIO
    return f"{path}: {os.strerror(number)}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m services.servos.guard", description="Stop wheels on a servo line.")
    add_arguments(parser)
    parser.add_argument("--baud", type=int, default=1_000_000)
    parser.add_argument("--stop", type=bytes.fromhex, required=True, help="the packet that stops the wheels")
    parser.add_argument("--limp", type=bytes.fromhex, required=True, help="the packet that makes them limp")
    options = parser.parse_args()

    def make(channel: socket.socket, point: StopPoint | None) -> Guard:
        return Guard(Port(options.port, options.baud), GuardLogic(options.stop, options.limp), channel, point)

    return run(options, make)


if __name__ == "__main__":
    sys.exit(main())
