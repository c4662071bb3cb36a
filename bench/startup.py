"""Start-up: `cocoro --help`, `status`, `stop` beside an import of zenoh; a robot, from `up` until it is ready.

Wall and processor time of whole processes, in turns. Processor time (user and system) changes little under load. The
word completions of a shell (Tab) are measured, too.
"""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

from bench.report import Report, turns

COCORO = str(Path(sys.executable).with_name("cocoro"))
ZENOH = (sys.executable, "-c", "import zenoh")
AT_MOST = 1.2
"""Upper bound of a command's time over that of `ZENOH`."""
LINES = (
    "cocoro f", "cocoro fetch r", "cocoro up --scene p", "cocoro up --profile s", "cocoro status --robot c",
    "cocoro echo planning/s", "cocoro logs p", "cocoro capture i", "cocoro replay latest", "cocoro rehearse go-to b",
)  # fmt: skip
FRAMES = "320x240@15"
NEW_NETWORK = 0x40000000
"""CLONE_NEWNET, see unshare(2)."""


class Took(NamedTuple):
    wall_ms: float
    processor_ms: float


def took(command: tuple[str, ...], environment: dict[str, str], codes: tuple[int, ...] = (0,)) -> Took:
    """Time of one run of a command. Raises RuntimeError for another exit code."""
    before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    wall_s, after = time.perf_counter() - begun_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in codes:
        raise RuntimeError(f"{' '.join(command)} ended with exit code {done.returncode}: {done.stdout}{done.stderr}")
    processor_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return Took(wall_s * 1e3, processor_s * 1e3)


def measure(chosen: Namespace, report: Report) -> None:
    rounds = 7 if chosen.short else 31
    everywhere = alone_on_the_network()
    if not everywhere:
        report.notes.append("no network namespace here: `cocoro stop` is given the name of a robot, which takes longer")
    with tempfile.TemporaryDirectory(prefix="cs") as folder:
        environment = {
            **{name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "NO_COLOR")},
            "COCORO_RUN_DIR": f"{folder}/run", "COCORO_CAPTURE_DIR": f"{folder}/captures",
            "COCORO_STATE_DIR": f"{folder}/state", "COCORO_FRAMES": FRAMES,
        }  # fmt: skip
        stop = ("stop",) if everywhere else ("stop", "--robot", "calliope")
        compare(report, rounds, environment, "without a robot", {
            "cocoro --help": (COCORO, "--help"), "cocoro status": (COCORO, "status"), "cocoro stop": (COCORO, *stop),
        }, AT_MOST)  # fmt: skip
        with_a_robot(report, chosen.short, environment, stop)
        if not chosen.short:
            shells(report, environment)


def compare(
    report: Report,
    rounds: int,
    environment: dict[str, str],
    when: str,
    commands: dict[str, tuple[str, ...]],
    at_most: float | None,
) -> None:
    """Times of commands, and their ratios to Python that imports zenoh."""
    things: dict[str, Callable[[], Took]] = {"zenoh": partial(took, ZENOH, environment)}
    for name, command in commands.items():
        things[name] = partial(took, command, environment, (0, 1, 4))
    bare, *others = turns(rounds, 1, **things)
    report.value(f"python -c 'import zenoh', {when}", [one.wall_ms for one in bare], "ms")
    for name, samples in zip(commands, others, strict=True):
        report.value(f"{name}, {when}", [one.wall_ms for one in samples], "ms")
        for kind in Took._fields:
            over, under = ([getattr(one, kind) for one in each] for each in (samples, bare))
            what = f"{name} / import of zenoh, {when}, {kind.removesuffix('_ms')} time"
            report.ratio(what, over, under, at_most=at_most, better="less")


def with_a_robot(report: Report, short: bool, environment: dict[str, str], stop: tuple[str, ...]) -> None:
    """A simulated robot, small frames: from `up` until it is ready, commands that ask it, `down`."""
    up_s, down_s = [], []
    for turn in range(2 if short else 5):
        with finally_down(environment):
            up_s.append(took((COCORO, "up", "sim", "--detach"), environment).wall_ms / 1e3)
            if turn == 0:
                compare(report, 3 if short else 9, environment, "with a robot", {
                    "cocoro status": (COCORO, "status"), "cocoro stop": (COCORO, *stop),
                }, None)  # fmt: skip
            took((COCORO, "reset"), environment, (0, 1, 3))
            down_s.append(took((COCORO, "down"), environment).wall_ms / 1e3)
    report.value("cocoro up sim --detach, until all services are ready", up_s, "s")
    report.value("cocoro down", down_s, "s")


@contextmanager
def finally_down(environment: dict[str, str]) -> Iterator[None]:
    try:
        yield
    finally:
        subprocess.run([COCORO, "down"], env=environment, capture_output=True, check=False)


def shells(report: Report, environment: dict[str, str]) -> None:
    """Processor time of a shell's Tab key."""
    for line in LINES:
        asks = {"_COCORO_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
        times = [took((COCORO,), environment | asks).processor_ms for _ in range(5)]
        report.value(f"Tab after: {line}, processor time", times, "ms")


def alone_on_the_network() -> bool:
    """Moves this process to a network of its own, so that its `cocoro stop` reaches no other robot of the machine;
    returns whether that was allowed."""
    return bool(ctypes.CDLL(None, use_errno=True).unshare(NEW_NETWORK) == 0)
