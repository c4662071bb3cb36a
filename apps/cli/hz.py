"""`cocoro hz KEY`: rate, jitter and amount of data on a key."""

from __future__ import annotations

import asyncio
import sys
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from statistics import fmean, pstdev
from typing import Annotated, NamedTuple

import msgspec
import typer
from rich.live import Live
from rich.text import Text

from apps.cli import exits
from apps.cli.interrupt import interrupt_event
from apps.cli.link import joined
from apps.cli.listening import KeyListener, keyexpr_of, nothing_on, takes_frames
from apps.cli.options import JsonOption, KeyArgument, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import print_json
from apps.cli.terminal import Column, FittedTable, table
from cocoro.bus.base import Payload
from cocoro.installed import topic_named
from cocoro.stream_checks import ANY_HZ, SequenceTracker
from deploy.rates import meant_hz, off

COLUMNS = (
    "key", Column("rate", right=True), Column("nominal", right=True), Column("by stamp", 4, right=True),
    Column("period", 6, right=True), Column("jitter", 1, right=True), Column("min", 5, right=True),
    Column("max", 3, right=True), Column("data", right=True), Column("message", 2, right=True),
    Column("lost", right=True), Column("", text=True),
)  # fmt: skip
SHOW_S = 1.0
SILENT_PERIODS = 3.0
"""When nothing arrives for this many of its periods, that is said."""


class MessageHeader(msgspec.Struct, gc=False):
    """The fields that every message has; a foreign payload may have none of them."""

    stamp_ns: int = 0
    seq: int = 0
    incarnation: int = 0


class Arrival(NamedTuple):
    at_s: float
    size: int
    stamp_ns: int


@dataclass(frozen=True)
class RateReport:
    """Figures of one key over the last window."""

    key: str
    nominal_hz: float | None
    """The rate that is meant on this robot, in the robot's time; None for what is published on change."""
    rate_hz: float
    """Rate of arrival here."""
    stamped_hz: float | None
    """Rate by the messages' stamps, in the robot's time, which a slow simulator stretches; None without stamps."""
    period_ms: float | None
    jitter_ms: float | None
    """Standard deviation of the periods between arrivals."""
    min_ms: float | None
    max_ms: float | None
    bytes_per_s: float
    size_bytes: float
    """Mean size of a message."""
    messages: int
    """Messages in the window."""
    lost: int
    """Missing sequence numbers since the start."""
    silent_s: float
    """Time since the newest message."""
    off: str
    """Whether the rate by the stamps, or the rate of arrival where there are none, differs from the meant one."""


class RateMeter:
    """Measures one key from its messages' arrivals, over the last `window_s`."""

    def __init__(self, key: str, nominal_hz: float | None, window_s: float) -> None:
        self.key = key
        self._nominal_hz = nominal_hz
        self._window_s = window_s
        self._arrivals: deque[Arrival] = deque()
        self._source = SequenceTracker()

    def hear(self, payload: Payload, at_s: float) -> None:
        try:
            head = msgspec.msgpack.decode(payload, type=MessageHeader)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError):
            head = MessageHeader()  # a foreign payload has a rate, too
        self._count(head)
        self._arrivals.append(Arrival(at_s, len(payload), head.stamp_ns))

    def _count(self, head: MessageHeader) -> None:
        """Counts losses as a reader does; an impossible sequence number counts as none."""
        source = self._source
        if head.incarnation != source.incarnation:
            source.begin(head.incarnation)
        elif head.seq != source.seq + 1:
            lost = source.jump(head.seq, head.stamp_ns, self._nominal_hz or ANY_HZ, None)
            if lost is None:
                return
            source.gaps += lost
        source.seq, source.stamp_ns = head.seq, head.stamp_ns
        source.settle()

    def report(self, now_s: float) -> RateReport | None:
        """The figures at a time of the monotonic clock; None before the first message."""
        if not self._arrivals:
            return None
        newest = self._arrivals[-1]
        while len(self._arrivals) > 1 and self._arrivals[0].at_s < now_s - self._window_s:
            self._arrivals.popleft()
        arrivals = list(self._arrivals)
        periods_s = [b.at_s - a.at_s for a, b in pairwise(arrivals)]
        span_s = newest.at_s - arrivals[0].at_s
        silent_s = now_s - newest.at_s
        if periods_s and silent_s > max(SILENT_PERIODS * fmean(periods_s), max(periods_s)):
            span_s += silent_s
        stamped_s = (newest.stamp_ns - arrivals[0].stamp_ns) / 1e9
        size = fmean(arrival.size for arrival in arrivals)
        rate_hz = len(periods_s) / span_s if span_s > 0 else 0.0
        return RateReport(
            key=self.key,
            nominal_hz=self._nominal_hz,
            rate_hz=rate_hz,
            stamped_hz=len(periods_s) / stamped_s if stamped_s > 0 else None,
            period_ms=1e3 * fmean(periods_s) if periods_s else None,
            jitter_ms=1e3 * pstdev(periods_s) if periods_s else None,
            min_ms=1e3 * min(periods_s) if periods_s else None,
            max_ms=1e3 * max(periods_s) if periods_s else None,
            bytes_per_s=rate_hz * size,
            size_bytes=size,
            messages=len(arrivals),
            lost=self._source.gaps,
            silent_s=silent_s,
            off=off(len(periods_s) / stamped_s if stamped_s > 0 else rate_hz, self._nominal_hz) if periods_s else "",
        )


app = typer.Typer()


@app.command()
def hz(
    key: KeyArgument,
    window: Annotated[
        float, typer.Option(min=0.5, max=600.0, metavar="S", help="The figures are over this last time.")
    ] = 5.0,
    once: Annotated[bool, typer.Option("--once", help="Measure one window and end.")] = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Rate, jitter and amount of data on a key, as it arrives here, over the last seconds.

    NOMINAL is the rate that is meant, in the robot's time; BY STAMP, the rate in that time, is judged against it.
    """
    sys.exit(asyncio.run(show_rates(RobotChoice(robot, site), key, window, once, json)))


async def show_rates(choice: RobotChoice, text: str, window_s: float, once: bool, as_json: bool) -> int:
    """Measures until interrupted, or with `once` over one window; the exit code is 1 when nothing arrived in it."""
    meters: dict[str, RateMeter] = {}
    async with joined(choice, frames=takes_frames(text)) as link:
        listener = KeyListener(link, keyexpr_of(text, link.robot))
        resolved = link.run_dir.resolved()
        with interrupt_event() as end, _view(as_json, once) as view:
            show_s = time.monotonic() + (window_s if once else SHOW_S)
            while not end.is_set():
                await listener.wait(end, max(show_s - time.monotonic(), 0.0))
                for received in listener.take():
                    if received.key not in meters:
                        topic = topic_named(received.key.removeprefix(f"{link.robot}/"))
                        meters[received.key] = RateMeter(received.key, meant_hz(topic, resolved), window_s)
                    meters[received.key].hear(received.payload, received.at_s)
                if time.monotonic() >= show_s:
                    show_s = time.monotonic() + SHOW_S
                    view.show(_reports(meters.values()), listener.keyexpr)
                    if once:
                        break
        if listener.dropped:
            print(
                f"cocoro: {listener.dropped} messages arrived too fast and are not in the figures",
                file=sys.stderr,
            )
        if end.is_set() and not once:
            return exits.DONE
    return exits.DONE if meters else exits.FAILED


def _reports(meters: Iterable[RateMeter]) -> list[RateReport]:
    now_s = time.monotonic()
    found = (meter.report(now_s) for meter in sorted(meters, key=lambda meter: meter.key))
    return [report for report in found if report is not None]


class _RateDisplay:
    """Prints JSON lines, a table that is rewritten in place on a terminal, or one table after the other elsewhere."""

    def __init__(self, as_json: bool, live: Live | None) -> None:
        self._as_json = as_json
        self._live = live

    def __enter__(self) -> _RateDisplay:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, reports: list[RateReport], keyexpr: str) -> None:
        if self._as_json:
            print_json([asdict(report) for report in reports])
            return
        nothing = nothing_on(keyexpr)
        if self._live is not None:
            shown = FittedTable(COLUMNS, map(_row, reports)) if reports else Text(nothing)
            self._live.update(shown, refresh=True)
        else:
            print(rows(reports) if reports else f"{nothing}\n", end="", flush=True)


def _view(as_json: bool, once: bool) -> _RateDisplay:
    watched = sys.stdout.isatty() and not as_json and not once
    return _RateDisplay(as_json, Live(auto_refresh=False, vertical_overflow="visible") if watched else None)


def rows(reports: list[RateReport]) -> str:
    return table(COLUMNS, [_row(report) for report in reports])


def _row(report: RateReport) -> tuple[str, ...]:
    def ms(value: float | None) -> str:
        return "-" if value is None else f"{value:.1f} ms"

    def per_s(value: float | None) -> str:
        return "-" if value is None else f"{value:.1f} Hz"

    stopped = report.period_ms is not None and 1e3 * report.silent_s > SILENT_PERIODS * report.period_ms + 100
    return (
        report.key.partition("/")[2], per_s(report.rate_hz), per_s(report.nominal_hz), per_s(report.stamped_hz),
        ms(report.period_ms), ms(report.jitter_ms), ms(report.min_ms), ms(report.max_ms),
        f"{size_text(report.bytes_per_s)}/s", size_text(report.size_bytes), str(report.lost),
        f"nothing for {report.silent_s:.1f} s" if stopped else report.off,
    )  # fmt: skip


def size_text(size: float) -> str:
    """A number of bytes with its unit, in powers of 1000."""
    for unit, factor in (("MB", 1e6), ("kB", 1e3)):
        if size >= factor:
            return f"{size / factor:.1f} {unit}"
    return f"{size:.0f} B"
