"""What trials share: the forms of their options, and runs that are good or bad."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from apps.cli.options import frames_of, latencies_of
from bench.report import Figure, Report
from cocoro.errors import CocoroError, ConfigError, choice_of

T = TypeVar("T")


def number_of(text: str) -> int:
    """Type of an option that is a number of trials. Raises ArgumentTypeError for less than one."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number, at least 1")
    return int(text)


def span(text: str) -> range:
    """Type of an option that is a range: '0:40' are 0 to 39. Raises ArgumentTypeError for another form, or an empty
    range."""
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal()) or int(first) >= int(end):
        raise argparse.ArgumentTypeError(f"{text}: write it as FROM:TO, for example 0:40, which is 0 to 39")
    return range(int(first), int(end))


def one_of(names: Iterable[str]) -> Callable[[str], str]:
    """Type of an argument that is one of these names, each of several. (With `nargs="*"`, argparse checks its `choices`
    against the empty list, too.)"""
    known = [*names]

    def name(text: str) -> str:
        if text not in known:
            raise argparse.ArgumentTypeError(f"{text}: {choice_of(text, known)}")
        return text

    return name


def add_frames(parser: argparse.ArgumentParser, default: str) -> None:
    """The option `--frames WxH@HZ`, as fields of a rehearsal's request."""

    def frames(text: str) -> dict[str, int | float]:
        try:
            return frames_of(text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error).partition(" ")[2]) from error

    parser.add_argument("--frames", type=frames, default=default, metavar="WxH@HZ", help=f"of the camera ({default})")


def add_latency(parser: argparse.ArgumentParser) -> None:
    """The option `--latency NAME=S`, repeatable: a list of seconds by service."""

    def latency(text: str) -> dict[str, float]:
        try:
            return latencies_of([text])
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error).partition(" ")[2]) from error

    parser.add_argument(
        "--latency", type=latency, action="append", default=[], metavar="NAME=S",
        help="added to each step of a service, for example perception=0.2; repeatable",
    )  # fmt: skip


def add_jobs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=number_of, default=2, help="processes that run trials at once (2)")


def sized(chosen: argparse.Namespace, given: T | None, full: T, short: T) -> T:
    """What was given, or else what fits the form of the run."""
    if given is not None:
        return given
    return short if chosen.short else full


class Runs:
    """Runs that are good or bad. Each is said; a bad one is a note, too."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self.good = 0
        self.count = 0

    def add(self, good: bool, line: str, details: Sequence[str] = ()) -> None:
        """One run: whether it was good, in a line, and what else to note of a bad one."""
        self.count += 1
        self.good += good
        self._report.say(f"{'ok ' if good else 'BAD'} {line}")
        if not good:
            self._report.notes += [" ".join(text.split()) for text in (line, *details) if text.strip()]

    def share(self, name: str, at_least: int | None = None) -> Figure:
        """The figure of the good ones, of which at least so many must be; None: all. Raises CocoroError where
        nothing ran."""
        if not self.count:
            raise CocoroError(f"{name}: no trial came about")
        return self._report.share(name, self.good, self.count, at_least=self.count if at_least is None else at_least)
