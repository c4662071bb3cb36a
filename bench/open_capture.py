"""Compares `cocoro.open` with a loop over a capture's messages.

    python -m bench open [--seconds 600] [--times 7]

The capture has the small messages of a fetch over and over, packed with zstd as a recorder does. `cocoro.open` makes
three columns of a topic, or all. The loop reads the same messages as types and makes the same columns of them, as a
program without it would. They take turns. The figures are this process's CPU time, reader threads
included, from the file to the arrays.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from math import ceil
from pathlib import Path

import msgspec
import numpy as np

import cocoro
from bench.capture_format import MEMORY, SMALL_BYTES, write_here
from bench.report import Report, turns
from bench.trials import number_of, sized
from cocoro.capture.columns import flattened
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import CocoroError
from cocoro.messages import Message
from services.capture.keys import QueuedMessage

GOLDEN = Path(__file__).parent.parent / "tests" / "golden" / "fetch.mcap"
THREE = ("log_ns", "stamp_ns", "seq")
TOPICS = ("base/state", "planning/status", "arm/state")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, help="of the capture (600)")
    parser.add_argument("--times", type=number_of, help="turns (7)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    seconds, times = sized(chosen, chosen.seconds, 600.0, 60.0), sized(chosen, chosen.times, 7, 3)
    with tempfile.TemporaryDirectory(prefix="cocoro-", dir=MEMORY if MEMORY.is_dir() else None) as name:
        path = Path(name) / "states.mcap"
        write_here([*made(seconds)], path)
        for topic in TOPICS:
            same(path, topic)
            compare(report, times, path, (topic,), 1.0)
        compare(report, times, path, TOPICS, 1.2)


def compare(report: Report, times: int, path: Path, topics: tuple[str, ...], at_least: float) -> None:
    """The ways to have topics as columns take turns."""

    def three() -> None:
        for topic in topics:
            looped(path, topic)

    def every() -> None:
        for topic in topics:
            flattened(messages(path, topic))

    ours, theirs, all_ours, all_theirs = turns(
        times,
        ours=_spent(lambda: opened(path, topics, THREE)),
        theirs=_spent(three),
        all_ours=_spent(lambda: opened(path, topics)),
        all_theirs=_spent(every),
    )
    name = f"{', '.join(topics)} ({opened(path, topics)} messages)"
    report.value(f"{name}, three columns by cocoro.open", ours, "ms")
    report.ratio(f"{name}, three columns: a loop / cocoro.open", theirs, ours, at_least=at_least)
    report.value(f"{name}, all columns by cocoro.open", all_ours, "ms")
    report.ratio(f"{name}, all columns: a loop / cocoro.open", all_theirs, all_ours, at_least=1.3)


def made(seconds: float) -> Iterator[QueuedMessage]:
    """The small messages of a recorded fetch, over and over with later times, in order."""
    with Capture.open(GOLDEN) as capture:
        once = [one for one in capture.messages() if len(one.payload) < SMALL_BYTES]
        lasts_ns = capture.end_ns - capture.start_ns
    for turn in range(ceil(seconds * NS / lasts_ns)):
        later_ns = turn * lasts_ns
        for one in once:
            when_ns = one.log_ns + later_ns, one.publish_ns + later_ns
            yield QueuedMessage(one.key, one.sequence, *when_ns, bytes(one.payload))


def opened(path: Path, topics: tuple[str, ...], columns: tuple[str, ...] = ()) -> int:
    """These columns of the topics, by default all; returns how many messages they have."""
    with cocoro.open(path) as capture:
        capture.load(*topics)
        for topic in topics:
            for column in columns or capture[topic]:
                capture[topic][column]
        return sum(capture[topic].rows for topic in topics)


def messages(path: Path, topic: str) -> list[msgspec.Struct]:
    """The messages of a topic, as types."""
    with Capture.open(path) as capture:
        return [capture.read(record) for record in capture.messages(topic)]


def looped(path: Path, topic: str) -> int:
    """Three columns of a topic, as a program without `cocoro.open` makes them."""
    log_ns, stamp_ns, seq = [], [], []
    with Capture.open(path) as capture:
        for record in capture.messages(topic):
            message = capture.read(record)
            assert isinstance(message, Message)
            log_ns.append(record.log_ns)
            stamp_ns.append(message.stamp_ns)
            seq.append(message.seq)
    return len(np.array(log_ns)) + len(np.array(stamp_ns)) + len(np.array(seq))


def same(path: Path, topic: str) -> None:
    """Raises CocoroError when the two make different columns."""
    with cocoro.open(path) as capture:
        ours = capture[topic]
    for name, column in flattened(messages(path, topic)).items():
        if not np.array_equal(ours[name], column, equal_nan=column.dtype == np.float64):
            raise CocoroError(f"{topic}: the two make different columns of {name}")


def _spent(action: Callable[[], object]) -> Callable[[], float]:
    """A function that returns the CPU time of a call, ms."""

    def way() -> float:
        begun_ns = time.process_time_ns()
        action()
        return (time.process_time_ns() - begun_ns) / 1e6

    return way
