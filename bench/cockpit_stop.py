"""STOP of a page: from the click until the wheels are commanded zero, and until the robot rests, by the true motion.

The robot turns on its place, driven by hand from the page, at full rate; at a random moment the page sends its stop.
While it does so, several viewers look at pictures. The client is on the same machine; a browser adds its own time
from the pointer's event to the sending, some milliseconds.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection

from bench.cockpit_pictures import started
from bench.cockpit_viewer import WAIT_S, opened
from bench.live import operator
from bench.report import Report
from bench.trials import Runs, number_of, sized
from cocoro.errors import CocoroError
from sim.motion import MotionRow, read_motion

TURN_RADPS = 1.5
FULL_SHARE = 0.6
"""Share of that rate from which the robot counts as turning: a busy machine's inputs come unevenly."""
BOUND_MS, WORST_MS = 60.0, 200.0
RESTS_MPS = 0.01
RESTS_MS = 300.0
TURNS_MPS = 0.05
"""Speed of a wheel from which the robot turns."""
WATCH_NS = 2_000_000_000
PATIENCE_S = 20.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="stops (20)")
    parser.add_argument("--viewers", type=int, default=2, help="pages that look meanwhile (2)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    count = sized(chosen, chosen.count, 20, 3)
    runs = Runs(report)
    sent_ns: list[int] = []
    with operator() as cocoro:
        motion = cocoro.run_dir.root / "motion"
        port = started(cocoro, "--set", f"service.sim.motion={json.dumps(str(motion))}")
        argv = [sys.executable, "-m", "bench.cockpit_viewer", str(port), "86400"]
        viewers = [subprocess.Popen(argv, stdout=subprocess.DEVNULL) for _ in range(chosen.viewers)]
        told: list[float] = []
        try:
            with opened(port) as socket:
                page = TurningPage(socket)
                for number in range(1, count + 1):
                    at_ns, ms = _stopped_turning(page, random.Random(number).uniform(0.3, 0.8))
                    sent_ns.append(at_ns)
                    told.append(ms)
                    runs.add(True, f"{number}: the first acknowledgement is shown after {ms:.1f} ms")
        finally:
            for viewer in viewers:
                viewer.kill()
                viewer.wait()
        time.sleep(0.5)
        zero, rest = by_the_truth(motion, sent_ns)
    if not zero:
        raise CocoroError("the robot stood before each stop: this machine is too busy")
    report.value("from the click to the first acknowledgement on the page", told, "ms")
    report.value("from the click to zero commanded", zero, "ms", at_most=BOUND_MS)
    report.value("the latest of them", [max(zero)], "ms", at_most=WORST_MS)
    report.value("from the click to rest", rest, "ms", at_most=RESTS_MS)
    report.value("the latest rest", [max(rest)], "ms", at_most=RESTS_MS)


def _stopped_turning(page: TurningPage, turns_s: float) -> tuple[int, float]:
    """Turn for so long at full rate, then stop; returns as `TurningPage.stop`."""
    page.begin()
    page.turn(lambda turned_s: turned_s >= turns_s and page.turns)
    return page.stop()


class TurningPage:
    """An operator's page that turns the robot on its place, and stops it."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._ids = itertools.count(1)
        self._tick = 0
        self._speed_radps = 0.0
        self.say({"do": "pictures", "on": False})

    def say(self, order: dict[str, Any]) -> None:
        self._socket.send(json.dumps(order))

    def begin(self) -> None:
        """Release the robot and take it. Raises CocoroError when it is not to be had."""
        deadline_s = time.monotonic() + PATIENCE_S
        for do in ("reset", "begin-drive"):
            while not self._asked({"do": do}):
                if time.monotonic() > deadline_s:
                    raise CocoroError(f"{do}: the robot is not to be had")
                time.sleep(0.2)

    def turn(self, over: Callable[[float], bool]) -> None:
        """Turn at full rate until `over` is true of the time since the robot turns, s. Raises CocoroError when it does
        not turn."""
        deadline_s = time.monotonic() + PATIENCE_S
        turns_since_s: float | None = None
        while turns_since_s is None or not over(time.monotonic() - turns_since_s):
            if time.monotonic() > deadline_s:
                raise CocoroError("the robot does not turn")
            self.say({"do": "drive", "tick": self._tick, "motion": {"turn_radps": TURN_RADPS}})
            self._until(lambda message: message["kind"] == "tick")
            if turns_since_s is None and self.turns:
                turns_since_s = time.monotonic()
            time.sleep(0.02)

    def stop(self) -> tuple[int, float]:
        """Stop the robot; returns when that was sent (CLOCK_MONOTONIC), and the time to the first acknowledgement,
        ms. Raises CocoroError without one."""
        sent_ns = time.monotonic_ns()
        self.say({"do": "stop", "id": next(self._ids)})
        self._until(lambda message: message["kind"] == "stopped")
        shown_ms = (time.monotonic_ns() - sent_ns) / 1e6
        self._until(lambda message: message["kind"] == "reply")
        return sent_ns, shown_ms

    @property
    def turns(self) -> bool:
        """Whether the robot turns, by its newest state."""
        return abs(self._speed_radps) > FULL_SHARE * TURN_RADPS

    def _asked(self, order: dict[str, Any]) -> bool:
        """Whether a request was carried out."""
        id = next(self._ids)
        self.say({**order, "id": id})
        return bool(self._until(lambda message: message["kind"] == "reply" and message["id"] == id)["ok"])

    def _until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            try:
                text = self._socket.recv(timeout=WAIT_S)
            except TimeoutError:
                continue
            if isinstance(text, bytes):
                continue
            message: dict[str, Any] = json.loads(text)
            if message["kind"] == "tick":
                self._tick = message["tick"]
            elif message["kind"] == "state" and message["base"] is not None:
                self._speed_radps = message["base"]["turn_radps"]
            if wanted(message):
                return message
        raise CocoroError("the cockpit does not answer")


def by_the_truth(file: Path, sent_ns: list[int]) -> tuple[list[float], list[float]]:
    """For each stop the times, ms, until the wheels' speed began to fall, and until the body rested; without those
    before which the robot stood already, since its driver was late."""
    rows = list(read_motion(file))
    zero: list[float] = []
    rest: list[float] = []
    for at_ns in sent_ns:
        after = [row for row in rows if at_ns <= row.real_ns < at_ns + WATCH_NS]
        if not after or after[0].asked_mps < TURNS_MPS:
            continue
        zero.append(_first(after, lambda row, before: row.asked_mps < before.asked_mps - 1e-6, at_ns))
        rest.append(_first(after, lambda row, _: row.moves_mps < RESTS_MPS, at_ns))
    return zero, rest


def _first(rows: list[MotionRow], is_it: Callable[[MotionRow, MotionRow], bool], at_ns: int) -> float:
    for before, row in itertools.pairwise(rows):
        if is_it(row, before):
            return (row.real_ns - at_ns) / 1e6
    raise CocoroError("the robot did not stop within two seconds")
