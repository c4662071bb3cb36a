"""How `bench.lost_control` loses a driver: the processes that drive, and what happens to them or to the robot's."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from bench.faults_live import LiveRobot
from bench.live import NAME, Operator
from bench.lost_control_driver import SENT
from cocoro import topics
from cocoro.messages import EstopRequest
from deploy.rundir import Target

Kind = Literal["program", "page", "browser"]
MODULES: dict[Kind, str] = {"program": "driver", "page": "page", "browser": "browser"}
END_S: dict[Kind, float] = {"program": 0.0, "page": 0.0, "browser": 5.0}
"""Time for a process to end by itself at the end of its input."""


class Driver:
    """A process that drives: it waits, ready, until `go`. `sent` is the file of the times at which it sent what was
    accepted."""

    def __init__(self, cocoro: Operator, sent: Path, kind: Kind) -> None:
        self._sent = sent
        sent.write_bytes(b"")
        self._end_s = END_S[kind]
        command = [sys.executable, "-m", f"bench.lost_control_{MODULES[kind]}", NAME, str(sent)]
        self._process = subprocess.Popen(
            command, env=cocoro.environment, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip

    def go(self, port: int) -> None:
        """Let it drive. `port`: of the cockpit."""
        self._sent.write_bytes(b"")
        self.say(str(port))

    @property
    def runs(self) -> bool:
        return self._process.poll() is None

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def last_sent_ns(self) -> int:
        """When it sent the last request whose motion was accepted, CLOCK_MONOTONIC; 0 before the first."""
        data = self._sent.read_bytes()
        whole = len(data) // SENT.size * SENT.size
        return int(SENT.unpack_from(data, whole - SENT.size)[0]) if whole else 0

    def end(self) -> str:
        """End it, with its browser; returns the end of what it said."""
        with suppress(subprocess.TimeoutExpired):
            self._process.communicate(timeout=self._end_s)  # the end of its input lets a browser end in order
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        said = self._process.communicate()[1]
        return said[-300:].replace("\n", " ")


class Loss(NamedTuple):
    """One way to lose a driver."""

    kind: Kind
    happens: Callable[[LiveRobot, Driver], None]


def _says(line: str) -> Callable[[LiveRobot, Driver], None]:
    return lambda robot, driver: driver.say(line)


def _signal(number: signal.Signals) -> Callable[[LiveRobot, Driver], None]:
    return lambda robot, driver: driver.signal(number)


def _service(number: signal.Signals, service: str = "executive") -> Callable[[LiveRobot, Driver], None]:
    def send(robot: LiveRobot, driver: Driver) -> None:
        target = Target(robot.cocoro.run_dir.path / "claims" / service)
        target.signal(number)
        target.close()

    return send


def _stop(robot: LiveRobot, driver: Driver) -> None:
    robot.node.spawn(robot.node.call_all(topics.ESTOP.of("*"), EstopRequest(by="bench")))


LOSSES: dict[str, Loss] = {
    "driver killed": Loss("program", _signal(signal.SIGKILL)),
    "driver stopped": Loss("program", _signal(signal.SIGSTOP)),
    "driver frozen": Loss("program", _says("freeze")),
    "let go": Loss("program", _says("let-go")),
    "executive killed": Loss("program", _service(signal.SIGKILL)),
    "executive stopped": Loss("program", _service(signal.SIGSTOP)),
    "emergency stop": Loss("program", _stop),
    "page killed": Loss("page", _signal(signal.SIGKILL)),
    "page stopped": Loss("page", _signal(signal.SIGSTOP)),
    "page frozen": Loss("page", _says("freeze")),
    "page lets go": Loss("page", _says("let-go")),
    "page, cockpit killed": Loss("page", _service(signal.SIGKILL, "cockpit")),
    "page, cockpit stopped": Loss("page", _service(signal.SIGSTOP, "cockpit")),
    "browser, page closed": Loss("browser", _says("close")),
    "browser, page crashed": Loss("browser", _says("crash")),
    "browser, another tab in front": Loss("browser", _says("switch")),
    "browser, page frozen": Loss("browser", _says("freeze")),
    "browser, key released": Loss("browser", _says("let-go")),
}


class Drivers:
    """Hands out drivers that are ready: a browser serves many trials, a program one."""

    def __init__(self, cocoro: Operator, folder: Path) -> None:
        self._cocoro = cocoro
        self._folder = folder
        self._ready: dict[Kind, Driver] = {}
        self._made = 0

    def prepare(self, kind: Kind) -> None:
        """Start a driver of this kind, if none is ready."""
        if kind not in self._ready:
            self._made += 1
            self._ready[kind] = Driver(self._cocoro, self._folder / f"sent-{self._made}", kind)

    def take(self, kind: Kind) -> Driver:
        """A driver of this kind."""
        self.prepare(kind)
        return self._ready.pop(kind)

    def give_back(self, driver: Driver, kind: Kind) -> str:
        """A trial is over; returns the end of what its driver said, where that has ended."""
        if kind == "browser" and driver.runs:
            driver.say("again")
            self._ready[kind] = driver
            return ""
        return driver.end()

    def close(self) -> None:
        """End those that are left."""
        for driver in self._ready.values():
            driver.end()
