"""The two sides of the bench `hardware-faults`: the emulated robot and the services' process."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from bench.hardware_driver import REACH_RAD, SPEED_RADPS
from cocoro.robot import Robot
from sim.wire.create import EmulatedCreate
from sim.wire.dynamixel import EmulatedDynamixel
from sim.wire.emulator import Emulator, SimplePlant
from sim.wire.servo import EmulatedServoBus

NS, MS = 1_000_000_000, 1_000_000
SEEN_S = 8.0
LINES = ("create", "arm", "hand")
ROBOT = Robot.load()
SLACK_COUNTS = 25


class Hardware:
    """The emulated robot and the commands that reached it."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.create = EmulatedCreate()
        self.buses = {
            "arm": EmulatedServoBus([EmulatedDynamixel(number, 28) for number in range(1, 7)]),
            "hand": EmulatedServoBus([EmulatedDynamixel(number) for number in (7, 8, 9)]),
        }
        self.servos = {servo.number: servo for bus in self.buses.values() for servo in bus.servos}
        self.body = SimplePlant(self.create, *self.buses.values())
        self.emulator = Emulator(folder, {"create": self.create, **self.buses}, self.body, seed)
        self.limits = {}
        for name, joint in ROBOT.joints.items():
            reach = REACH_RAD.get(name, 0.0)
            ends = sorted((joint.to_count(-reach), joint.to_count(reach)))
            self.limits[joint.id] = ends[0] - SLACK_COUNTS, ends[1] + SLACK_COUNTS

    def wheel_log(self) -> list[tuple[int, tuple[int, int]]]:
        """Wheel commands since the last call."""

        def take() -> list[tuple[int, tuple[int, int]]]:
            log = list(self.create.acted)
            self.create.acted[:] = []
            return log

        return self.emulator.call(take)

    def wrong_goals(self) -> list[str]:
        """Since the last call: goals outside the commanded range of a joint, and speeds above the commanded ones."""
        limit = round(max(SPEED_RADPS, 1.0) / 0.011623892) + 1  # a held joint moves at 1 rad/s

        def take() -> list[str]:
            wrong = []
            for number, servo in self.servos.items():
                low, high = self.limits[number]
                for _, address, value in servo.acted:
                    if (address == 30 and not low <= value <= high) or (address == 32 and not 0 < value <= limit):
                        wrong.append(f"servo {number}: {value} into {address}")
                servo.acted.clear()
            return wrong

        return self.emulator.call(take)


class Services:
    """The services' process."""

    def __init__(self, folder: Path) -> None:
        self._command = [sys.executable, "-m", "bench.hardware_driver", *(str(folder / line) for line in LINES)]
        self._said = folder / "said"
        self.starts = 0
        self.start()

    def start(self) -> None:
        with self._said.open("w") as said:
            self.process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, text=True
            )
        self.reports: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._read, args=(self.process, self.reports), daemon=True).start()
        self.starts += 1

    def _read(self, process: subprocess.Popen[str], reports: queue.SimpleQueue[dict[str, Any]]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            reports.put(json.loads(line))

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def last_words(self) -> str:
        """The exit code and last output of a process that ended."""
        lines = self._said.read_text(errors="replace").strip().splitlines()
        return f"ended with {self.process.poll()}: {' / '.join(lines[-3:])}"

    def say(self, what: str) -> None:
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # its end is noticed elsewhere
            self.process.stdin.write(json.dumps({"do": what}) + "\n")
            self.process.stdin.flush()

    def guard_pid(self) -> int | None:
        for child in psutil.Process(self.process.pid).children():
            if any("services.base.guard" in part for part in child.cmdline()):
                return child.pid
        return None

    def shows(self, texts: tuple[str, ...]) -> bool:
        """Whether one of these texts is reported within the time limit, not counting earlier reports."""
        while not self.reports.empty():
            self.reports.get()
        end_s = time.monotonic() + SEEN_S
        while (left_s := end_s - time.monotonic()) > 0:
            try:
                report = self.reports.get(timeout=left_s)
            except queue.Empty:
                return False
            if any(
                text in fault for fault in [*report["faults"], f"stopped by {report['stopped_by']}"] for text in texts
            ):
                return True
        return False

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
