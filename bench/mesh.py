"""One-way times of messages and frames between two processes: Node to Node, raw zenoh, and other middleware.

Node to Node is what services use: a typed message is stamped, numbered and encoded; the reader decodes, checks and
counts it before its handler is called, in the turn of an event loop. Raw zenoh is zenoh's own publisher and callback
with the same endpoint, options, shared memory and quality of service; its way ends in the callback, in zenoh's thread,
at the bytes. "raw zenoh, asyncio" hands each sample to an event loop, as a program with one has to. The other ways
end, too, where a program has the bytes (`bench/mesh_peers.py`).

A small message is 1 KiB: a `Detections` with seven objects, or as many bytes. Its latency hangs on the pause before it,
since processors sleep and caches cool: so there are four rates, "back to back" being one message after another, in both
directions. A frame is 640 x 480 pixels of colour and depth, 1.54 MB, in two arrays as the camera gives them, at 30 Hz.
Both processes read the same clock (CLOCK_BOOTTIME). All ways take turns, each round begins with another one; a ratio is
of the medians of one round. Messages that did not arrive are in the table.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from importlib.util import find_spec
from statistics import median
from typing import NamedTuple

from bench.mesh_pair import Pair, WayError, pairs
from bench.mesh_process import WAYS
from bench.report import Report, Table, number, percentile

OURS, RAW = "Node to Node", "raw zenoh"
NEEDS = {"pyzmq": "zmq", "iceoryx2": "iceoryx2", "eCAL": "ecal", "dora": "dora"}
"""The module of each way that is an extra package."""
FRAME_HZ = 30.0
SLOW_S = 1.0
"""Pause of the messages at 1 Hz: all ways send one each in it."""


class Mode(NamedTuple):
    """A kind of traffic, and how much of it is sent in one turn."""

    name: str
    messages: int
    hz: float
    frames: bool = False
    at_most: float | None = None
    """Bound of Node to Node over raw zenoh."""


MODES = (
    Mode("back to back", 200, 0.0, at_most=1.4),
    Mode("1,000 Hz", 200, 1000.0),
    Mode("50 Hz", 25, 50.0, at_most=1.2),
    Mode("frames", 15, FRAME_HZ, frames=True, at_most=1.1),
)
SLOW = "1 Hz"


def options(parser: ArgumentParser) -> None:
    parser.add_argument("--rounds", type=int, help="number of rounds; 10, or 4 in the short form")


def measure(chosen: Namespace, report: Report) -> None:
    rounds = chosen.rounds or (4 if chosen.short else 10)
    ways = [OURS, RAW, "raw zenoh, asyncio"] if chosen.short else list(WAYS)
    missing = [way for way in ways if way in NEEDS and find_spec(NEEDS[way]) is None]
    for way in missing:
        report.notes.append(f"{way} is not installed: pip install -e '.[bench]'")
    with pairs([way for way in ways if way not in missing]) as (started, absent):
        for way, why in absent.items():
            if way in (OURS, RAW):
                raise WayError(f"{way}: {why}")
            report.notes.append(f"{way} does not work here: {why}")
        took = _all_turns(started, rounds, report)
        _all_slow(started, 3 if chosen.short else 12, took)
    _tell(took, report)


Took = dict[str, dict[str, list[list[float]]]]
"""By mode and way: the times of each turn, us."""


def _all_turns(started: dict[str, Pair], rounds: int, report: Report) -> Took:
    took: Took = {mode.name: {way: [] for way in started} for mode in (*MODES, Mode(SLOW, 1, 1.0))}
    for way in list(started):
        for mode in MODES:
            _turn(started, way, mode, report)
    names = list(started)
    for turn in range(rounds):
        first = turn % len(names)
        for mode in MODES:
            for way in names[first:] + names[:first]:
                if way in started and (times := _turn(started, way, mode, report)):
                    took[mode.name][way].append(times)
        report.say(f"round {turn + 1} of {rounds}")
    return took


def _turn(started: dict[str, Pair], way: str, mode: Mode, report: Report) -> list[float]:
    """One turn; of a way of others that fails, the rest of the bench goes without."""
    try:
        if mode.hz == 0.0:
            return started[way].bounces(mode.messages)
        return started[way].paced(mode.messages, mode.hz, mode.frames)
    except WayError as error:
        if way in (OURS, RAW):
            raise
        report.notes.append(f"{way} failed at {mode.name}: {error}")
        started.pop(way).close()
        return []


def _all_slow(started: dict[str, Pair], count: int, took: Took) -> None:
    """One message of each way in each second."""
    for _ in range(count):
        begun_s = time.monotonic()
        for way, pair in started.items():
            took[SLOW][way].append(pair.paced(1, 1.0))
        time.sleep(max(0.0, begun_s + SLOW_S - time.monotonic()))


def _tell(took: Took, report: Report) -> None:
    rows = []
    sent = {SLOW: 1} | {mode.name: mode.messages if mode.hz else 2 * mode.messages for mode in MODES}
    for name, at_most in ((SLOW, None), *((mode.name, mode.at_most) for mode in MODES)):
        by_way = {way: turns for way, turns in took[name].items() if turns}
        medians = {way: [median(times) for times in turns] for way, turns in by_way.items()}
        for way in (OURS, RAW):
            report.value(f"{way}, {name}", medians[way], "us")
        report.ratio(f"{OURS} / {RAW}, {name}", medians[OURS], medians[RAW], at_most=at_most, better="less")
        for way, turns in by_way.items():
            times = [each for turn in turns for each in turn]
            over = median(a / b for a, b in zip(medians[way], medians[RAW], strict=False))
            lost = len(turns) * sent[name] - len(times)
            figures = (median(times), percentile(times, 99.0), over)
            rows.append([name, way, *map(number, figures), f"{len(times):,}", f"{lost:,}"])
    head = ["traffic", "way", "median, us", "99%, us", f"over {RAW}", "messages", "lost"]
    report.tables.append(Table("One-way times of all ways", head, rows))
