"""The pure parts of `top`, `echo`, `hz` and `logs`: foreign payloads, rates, log files, how it all looks."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from apps.cli import top_view
from apps.cli.echo import jsonable, lines, read
from apps.cli.hz import RateMeter, rows, size_text
from apps.cli.listening import keyexpr_of, takes_frames
from apps.cli.logs import LogTail, entries, files_of, robot_of
from apps.cli.main import main
from cocoro.errors import ConfigError
from cocoro.messages import BaseCommand
from deploy.rundir import RunDir


def test_frames_may_be_among_what_is_not_known_to_be_something_else() -> None:
    for text in ("kinect/frame", "**", "kinect/*", "calliope/base/state", "parts/other"):
        assert takes_frames(text)
    for text in ("base/state", "planning/health", "sim/clock"):
        assert not takes_frames(text)


# --- keys and payloads ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "keyexpr"),
    [
        ("base/state", "calliope/base/state"),
        ("calliope/base/state", "calliope/base/state"),
        ("*/health", "calliope/*/health"),
        ("**", "calliope/**"),
    ],
)
def test_a_key_is_given_with_or_without_the_robots_name(text: str, keyexpr: str) -> None:
    assert keyexpr_of(text, "calliope") == keyexpr


@pytest.mark.parametrize("text", ["", "base//state", "/base", "base/st*"])
def test_what_is_no_key_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="base/state"):
        keyexpr_of(text, "calliope")


def command(**fields: Any) -> bytes:
    return msgspec.msgpack.encode(BaseCommand(ahead_mps=0.1, turn_radps=0.2, seq=7, **fields))


def test_a_known_type_is_named_and_a_good_message_of_it_has_no_problem() -> None:
    reading = read(command(), "base/command")
    assert (reading.type, reading.problem) == ("BaseCommand", "")
    assert reading.value["ahead_mps"] == 0.1


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        (msgpack.packb({"ahead_mps": "fast"}), "no good BaseCommand: Expected `float`, got `str`"),
        (msgpack.packb({"ahead_mps": math.nan, "turn_radps": 0.0}), "no good BaseCommand"),
        (b"\xc1\x00", "not MessagePack"),
        (b"", "not MessagePack"),
        (msgpack.packb({"ahead_mps": 0.1, "turn_radps": 0.1, "more": "x" * 70_000}), "at most 65536 are taken"),
    ],
)
def test_what_a_reader_would_reject_is_said_with_the_reason(payload: bytes, problem: str) -> None:
    assert problem in read(payload, "base/command").problem


def test_an_unknown_key_is_decoded_all_the_same() -> None:
    reading = read(msgpack.packb({"wave": [1, 2]}), "nearest/object")
    assert reading == ("", {"wave": [1, 2]}, "")


@given(st.binary(max_size=64))
def test_any_bytes_can_be_read_and_told_in_both_ways(payload: bytes) -> None:
    for topic in ("base/command", "somebody/else"):
        reading = read(payload, topic)
        json.loads(json.dumps(jsonable(reading.value), allow_nan=False))
        assert all(isinstance(line, str) for line in lines(reading.value))


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text() | st.integers(0, 9), inner, max_size=4),
    max_leaves=12,
)


@given(values)
def test_any_value_that_messagepack_carries_becomes_json(value: Any) -> None:
    reading = read(msgpack.packb(value), "somebody/else")
    assert reading.problem == ""
    json.loads(json.dumps(jsonable(reading.value), allow_nan=False))
    assert all("\n" not in line for line in lines(reading.value))


def test_fields_stand_in_lines_and_long_lists_are_cut_unless_all_is_wanted() -> None:
    value = {"label": "red_can", "pixels": b"xyz", "detections": [{"u": 1.23456789, "box": [1, 2]}], "many": [0] * 20}
    assert list(lines(value)) == [
        "  label: red_can",
        "  pixels: <3 bytes>",
        "  detections:",
        "    - u: 1.23457",
        "      box: [1, 2]",
        "  many: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, (8 more of 20)]",
    ]
    assert list(lines(value, everything=True))[-1].count("0") == 20


# --- rates ----------------------------------------------------------------------------------------


def test_rate_jitter_and_data_are_of_the_window() -> None:
    meter = RateMeter("calliope/base/command", 50.0, window_s=1.0)
    for number in range(301):
        late_s = 0.002 if number % 2 else 0.0
        message = BaseCommand(ahead_mps=0, turn_radps=0.0, seq=number, incarnation=1, stamp_ns=1 + number * 40_000_000)
        meter.hear(msgspec.msgpack.encode(message), number * 0.02 + late_s)
    report = meter.report(6.0)
    assert report is not None
    assert report.rate_hz == pytest.approx(50.0, rel=0.01)
    assert report.stamped_hz == pytest.approx(25.0)  # the robot's clock goes twice as fast as ours here
    assert report.off == "slower than meant"
    assert report.period_ms == pytest.approx(20.0, rel=0.01)
    assert report.jitter_ms == pytest.approx(2.0, rel=0.1)
    assert [report.min_ms, report.max_ms] == pytest.approx([18.0, 22.0])
    assert report.messages == 51
    assert report.lost == 0
    assert report.bytes_per_s == pytest.approx(report.size_bytes * report.rate_hz)


def test_a_key_that_stops_loses_its_rate_and_that_is_said() -> None:
    meter = RateMeter("calliope/base/command", 50.0, window_s=2.0)
    for number in range(50):
        meter.hear(command(), number * 0.02)
    lively, stopped = meter.report(1.0), meter.report(1.9)
    assert lively is not None
    assert stopped is not None
    assert lively.rate_hz == pytest.approx(50.0)
    assert stopped.rate_hz < 30.0
    assert "nothing for" not in rows([lively])
    assert "nothing for 0.9 s" in rows([stopped])


def test_gaps_in_the_sequence_are_losses_and_a_restart_is_none() -> None:
    meter = RateMeter("calliope/base/command", None, window_s=5.0)
    for at_s, (incarnation, seq) in enumerate([(1, 5), (1, 6), (1, 9), (2, 0), (2, 2)]):
        message = BaseCommand(ahead_mps=0, turn_radps=0.0, seq=seq, incarnation=incarnation)
        meter.hear(msgspec.msgpack.encode(message), float(at_s))
    report = meter.report(4.0)
    assert report is not None
    assert report.lost == 3


def test_a_number_that_cannot_be_traffic_is_no_loss() -> None:
    meter = RateMeter("calliope/base/command", 50.0, window_s=5.0)
    for number, seq in enumerate([5, 6, 2**62, 7, 9]):
        message = BaseCommand(ahead_mps=0, turn_radps=0.0, seq=seq, incarnation=1, stamp_ns=number * 20_000_000)
        meter.hear(msgspec.msgpack.encode(message), number * 0.02)
    report = meter.report(0.1)
    assert report is not None
    assert (report.lost, report.messages) == (1, 5)


def test_what_is_no_message_of_ours_has_a_rate_all_the_same() -> None:
    meter = RateMeter("calliope/somebody/else", None, window_s=5.0)
    assert meter.report(0.0) is None
    meter.hear(b"hello", 0.0)
    meter.hear(b"hello", 0.5)
    report = meter.report(0.6)
    assert report is not None
    assert (report.rate_hz, report.stamped_hz, report.size_bytes) == (2.0, None, 5.0)


def test_sizes_are_for_people() -> None:
    assert [size_text(size) for size in (96, 1500, 27e6)] == ["96 B", "1.5 kB", "27.0 MB"]


# --- logs -----------------------------------------------------------------------------------------

SIM = """2026-01-01T10:00:01.000 INFO    sim: up
2026-01-01T10:00:03.000 ERROR   sim: crashed
Traceback (most recent call last):
  boom
"""
SUPERVISOR = "2026-01-01 10:00:02,000 INFO    supervisor: sim ready in 1.0 s\n"


@pytest.fixture
def calliope(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunDir:
    """A robot that has been up."""
    monkeypatch.setenv("COCORO_RUN_DIR", str(tmp_path))
    run_dir = RunDir("calliope", tmp_path)
    run_dir.make()
    run_dir.log("sim").write_text(SIM)
    run_dir.log("supervisor").write_text(SUPERVISOR)
    run_dir.log("sim").with_name("sim.log.1").write_text("2026-01-01T09:00:00.000 INFO    sim: long ago\n")
    return run_dir


def test_logs_of_all_processes_are_in_one_order_and_tracebacks_stay_whole(
    calliope: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["logs"]) == 0
    first, *rest = SIM.splitlines()
    assert capsys.readouterr().out.splitlines() == [first, SUPERVISOR.rstrip(), *rest]


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        (["sim", "-n", "1"], SIM.splitlines()[1:]),
        (["kinect", "-n", "1"], SIM.splitlines()[1:]),  # a service of the process sim
        (["--level", "error"], SIM.splitlines()[1:]),
        (["supervisor"], [SUPERVISOR.rstrip()]),
        (["-n", "0"], []),
    ],
)
def test_logs_of_one_process_or_service_or_of_a_level(
    calliope: RunDir, capsys: pytest.CaptureFixture[str], arguments: list[str], shown: list[str]
) -> None:
    calliope.profile_file.write_text('{"processes": ["sim", "perception"]}')
    assert main(["logs", *arguments]) == 0
    assert capsys.readouterr().out.splitlines() == shown


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["teapot"], "no log of teapot; known are sim, supervisor"),
        (["--level", "loud"], "known are debug"),
        (["--robot", "robbie"], "no logs of robbie"),
    ],
)
def test_logs_that_are_not_there_are_bad_usage(
    calliope: RunDir, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert main(["logs", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_of_several_robots_one_must_be_named(calliope: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    other = RunDir("robbie", calliope.root)
    other.make()
    assert main(["logs"]) == 2
    assert "--robot calliope, --robot robbie" in capsys.readouterr().err
    assert robot_of("robbie").robot == "robbie"
    assert files_of(other, None) == []


def test_without_any_robot_logs_say_what_to_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COCORO_RUN_DIR", str(tmp_path / "none"))
    assert main(["logs"]) == 2
    assert "cocoro up sim" in capsys.readouterr().err


def test_a_crash_that_python_itself_tells_of_counts_as_grave() -> None:
    found = list(entries(["2026-01-01T10:00:01.000 INFO    sim: up", "Fatal Python error: Segmentation fault", "x"]))
    assert [entry.level for entry in found] == ["critical"]


def test_a_tail_reads_whole_lines_and_goes_on_in_the_file_that_takes_the_logs_place(tmp_path: Path) -> None:
    path = tmp_path / "sim.log"
    tail = LogTail(path)
    assert tail.read() == []
    path.write_text("2026-01-01T10:00:01.000 INFO    sim: up\n2026-01-01T10:00:02.000 INF")
    assert [entry.lines for entry in tail.read()] == [("2026-01-01T10:00:01.000 INFO    sim: up",)]
    with path.open("a") as file:
        file.write("O    sim: on\nand on\n")
    assert [entry.lines for entry in tail.read()] == [("2026-01-01T10:00:02.000 INFO    sim: on", "and on")]
    path.rename(tmp_path / "sim.log.1")
    path.write_text("2026-01-01T10:00:03.000 INFO    sim: again\n")
    assert [entry.lines[0][-5:] for entry in tail.read()] == ["again"]
    assert tail.read() == []
    with path.open("a") as file:
        file.write("2026-01-01T10:00:04.000 INFO    sim: last words\n")
    path.rename(tmp_path / "sim.log.1")
    path.write_text("2026-01-01T10:00:05.000 INFO    sim: once more\n")
    assert [entry.lines[0][32:] for entry in tail.read()] == ["sim: last words", "sim: once more"]
    tail.close()


# --- how top looks --------------------------------------------------------------------------------


def service(name: str, **more: Any) -> dict[str, Any]:
    health = {
        "pid": 7, "cpu_share": 0.5, "rss_mb": 100.0, "uptime_s": 3661.0, "text": "", "faults": [],
        "loops": [{"rate_hz": 49.9, "period_p99_ms": 21.0, "step_median_ms": 0.4, "overruns": 3}],
    }  # fmt: skip
    fresh = {
        "service": name, "process": "sim", "alive": True, "state": "ready", "silent_s": 0.2, "cpu_budget": 0.4,
        "rss_budget_mb": 200.0, "health": health,
    }  # fmt: skip
    return fresh | more


def topic(name: str, **more: Any) -> dict[str, Any]:
    reader = {
        "service": "planning",
        "skipped": 5,
        "lost": 2,
        "rejected": 1,
        "expired": 0,
        "growing": True,
        "last_error": "too big",
    }
    fresh = {
        "topic": name, "publisher": "base", "published": True, "count": 9, "rate_hz": 20.0, "nominal_hz": 50.0,
        "age_s": 0.3, "max_age_s": 0.15, "readers": [reader],
    }  # fmt: skip
    return fresh | more


def screen(*, services: Sequence[Any] = (), topics: Sequence[Any] = (), **more: Any) -> str:
    report: dict[str, Any] = {
        "robot": "calliope", "profile": "sim", "machine": {"cores": 2, "cpu_share": 0.25}, "clock": None,
        "clocks": [], "task": None, "plan": None, "latch": None, "base": None, "services": services, "topics": topics,
    }  # fmt: skip
    console = Console(width=200, color_system="standard", force_terminal=True)
    with console.capture() as capture:
        console.print(top_view.render(report | more))
    return capture.get()


RED = "\x1b[1;31m"


def test_a_service_over_its_budget_stands_out() -> None:
    text = screen(services=[service("planning")])
    assert f"{RED}50%" in text
    assert "100 MB" in text
    assert f"{RED}100 MB" not in text
    assert "1:01:01" in text


def test_services_of_one_process_tell_its_costs_once() -> None:
    text = screen(services=[service("sim"), service("base")])
    assert text.count("100 MB") == 1
    assert "as sim" in text


def test_a_dead_service_and_one_without_a_report_are_red() -> None:
    text = screen(
        services=[service("base", alive=False, state="not alive"), service("arm", state="no report", silent_s=8.0)]
    )
    assert f"{RED}not alive" in text
    assert f"{RED}no report" in text
    assert "no report of its health for 8 s" in text


def test_a_slow_late_topic_and_what_is_lost_or_rejected_stand_out_and_what_is_skipped_does_not() -> None:
    text = screen(topics=[topic("base/state")])
    assert "\x1b[33m20.0 Hz" in text
    assert f"{RED}300 ms" in text
    assert f"{RED} [too big]" in text
    for count, is_red in (("5", False), ("2", True), ("1", True)):
        assert any(f"{RED}{' ' * pad}{count}\x1b" in text for pad in range(9)) == is_red


def test_a_topic_that_nobody_publishes_names_who_would() -> None:
    text = screen(topics=[topic("base/state", published=False, count=0, age_s=None)])
    assert "(base)" in text


def test_the_headline_tells_of_the_clock_the_stop_and_the_task() -> None:
    text = screen(
        clock={"stamp_ns": 12_300_000_000, "rate": 0.5, "paused": False},
        latch={"state": "latched"},
        base={"battery_fraction": 0.87},
        task={"task_id": "1", "task": "fetch", "label": "red_can", "outcome": None, "phase": "approach",
              "elapsed_s": 3.0, "reason": "", "text": "driving"},
    )  # fmt: skip
    for words in ("clock 12.3 s x0.50", "EMERGENCY STOP latched", "battery 87%", "fetch red_can: approach, 3.0 s"):
        assert words in text
