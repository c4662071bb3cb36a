"""The conductor's side of one way to send in `bench.mesh`: starts its two processes and tells them what to do."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from bench.mesh_process import SOCKET, Role

START_S = 20.0
ANSWER_S = 120.0


class WayError(Exception):
    """A way to send does not work here; the text says why."""


class Pair:
    """The two processes of a way. A bounce is one message there and one back."""

    def __init__(self, way: str, log: Path) -> None:
        """Raises WayError when the processes do not start."""
        self.way = way
        self._folder = Path(tempfile.mkdtemp(prefix="mesh-"))
        self._lines: dict[Role, TextIO] = {}
        self._log = log.open("w")
        self._processes: list[subprocess.Popen[bytes]] = []
        try:
            with socket.socket(socket.AF_UNIX) as listening:
                listening.bind(str(self._folder / SOCKET))
                listening.listen()
                listening.settimeout(START_S)
                self._start()
                self._accept(listening)
        except (OSError, ValueError) as error:
            self.close()
            last = [line for line in log.read_text().splitlines() if line.strip()][-1:] or [str(error)]
            raise WayError(f"it did not start: {last[0].strip()}") from error

    def _start(self) -> None:
        # The daemon of dora starts both processes itself.
        roles = ["daemon"] if self.way == "dora" else ["b", "a"]
        environment = os.environ | {"PYTHONWARNINGS": "ignore"}
        for role in roles:
            command = [sys.executable, "-m", "bench.mesh_process", self.way, role, str(self._folder)]
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log, env=environment
            )
            self._processes.append(process)

    def _accept(self, listening: socket.socket) -> None:
        while len(self._lines) < 2:
            line, _ = listening.accept()
            line.settimeout(ANSWER_S)
            file = line.makefile("rw")
            self._lines[json.loads(file.readline())["role"]] = file

    def tell(self, role: Role, **order: Any) -> Any:
        """Give an order and return the answer. Raises WayError when the process has ended or does not answer."""
        file = self._lines[role]
        try:
            file.write(json.dumps(order) + "\n")
            file.flush()
            return json.loads(file.readline())
        except (OSError, ValueError) as error:
            raise WayError(f"its process {role} did not answer: {error}") from error

    def bounces(self, count: int) -> list[float]:
        """Times on the way of both directions, us, one message after another."""
        self.tell("b", do="expect", count=count, echo=True)
        answers = self.tell("a", do="bounce", count=count)
        return _us([*answers, *self.tell("b", do="arrived")])

    def paced(self, count: int, hz: float, frames: bool = False) -> list[float]:
        """Times on the way at a rate, us."""
        self.tell("b", do="expect", count=count, echo=False)
        self.tell("a", do="send", count=count, hz=hz, frames=frames)
        return _us(self.tell("b", do="arrived"))

    def close(self) -> None:
        """End the processes."""
        for file in self._lines.values():
            with contextlib.suppress(OSError):
                file.close()
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(2.0)
            if process.poll() is None:
                process.kill()
                process.wait()
        self._log.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def _us(took_ns: list[int]) -> list[float]:
    """Raises WayError when nothing arrived."""
    if not took_ns:
        raise WayError("no message arrived")
    return [took / 1e3 for took in took_ns]


@contextlib.contextmanager
def pairs(ways: list[str]) -> Iterator[tuple[dict[str, Pair], dict[str, str]]]:
    """The pairs of all ways that start, and why the others do not."""
    started: dict[str, Pair] = {}
    absent: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="mesh-logs-") as logs:
        try:
            for number, way in enumerate(ways):
                try:
                    started[way] = Pair(way, Path(logs) / f"{number}")
                except WayError as error:
                    absent[way] = str(error)
            yield started, absent
        finally:
            for pair in started.values():
                pair.close()
