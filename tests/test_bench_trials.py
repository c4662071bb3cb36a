"""What trials share: the forms of their options, and runs that are good or bad."""

from __future__ import annotations

import argparse
from typing import Any

import pytest

from bench.report import Report
from bench.trials import Runs, add_frames, add_latency, number_of, one_of, sized, span
from cocoro.errors import CocoroError


def test_options_are_read_into_what_a_trial_needs() -> None:
    parser = argparse.ArgumentParser()
    add_frames(parser, "640x480@30")
    add_latency(parser)
    parser.add_argument("--seeds", type=span)
    parser.add_argument("parts", nargs="*", type=one_of(["files", "records"]))
    chosen = parser.parse_args(["records", "--seeds", "3:5", "--latency", "perception=0.2", "--latency", "planning=1"])
    assert chosen.frames == {"width": 640, "height": 480, "frame_rate_hz": 30.0}
    assert chosen.latency == [{"perception": 0.2}, {"planning": 1.0}]
    assert ([*chosen.seeds], chosen.parts) == ([3, 4], ["records"])
    assert parser.parse_args([]).parts == []


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        (number_of, "0", "at least 1"),
        (number_of, "many", "whole number"),
        (span, "5", "FROM:TO"),
        (span, "5:5", "FROM:TO"),
        (one_of(["files", "records"]), "file", "did you mean files"),
    ],
)
def test_other_forms_are_refused_in_words(read: Any, text: str, said: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=said):
        read(text)


@pytest.mark.parametrize("words", [["--frames", "big"], ["--latency", "perception"]])
def test_a_wrong_option_ends_with_what_it_should_be(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_frames(parser, "640x480@30")
    add_latency(parser)
    with pytest.raises(SystemExit):
        parser.parse_args(words)
    assert f"argument {words[0]}: {words[1]}: write it as" in capsys.readouterr().err


def test_what_was_given_comes_before_what_fits_the_form() -> None:
    full, short = argparse.Namespace(short=False), argparse.Namespace(short=True)
    assert [sized(full, None, 20, 1), sized(short, None, 20, 1), sized(short, 7, 20, 1)] == [20, 1, 7]


def test_bad_runs_are_noted_and_the_share_of_good_ones_is_bounded() -> None:
    said: list[str] = []
    report = Report(said.append)
    runs = Runs(report)
    runs.add(True, "seed 0: held")
    runs.add(False, "seed 1:\n  lost", ["what it said"])
    assert [line[:3] for line in said] == ["ok ", "BAD"]
    assert report.notes == ["seed 1: lost", "what it said"]
    assert not runs.share("held").kept
    assert runs.share("held, at least one", 1).kept
    with pytest.raises(CocoroError, match="no trial"):
        Runs(report).share("nothing")
