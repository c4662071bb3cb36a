"""Log times when the wall clock is set, and when the machine sleeps."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
from capture_rig import all_of, entry, writer

from apps.captures.info import report
from apps.cli import capture as capture_command
from cocoro.capture.folder import captures, file_name, make_room
from cocoro.capture.reader import Capture
from cocoro.clock import NS, steady_ns
from services.capture.log_clock import KEPT_STEPS, TOGETHER_NS, WALL_CLOCK, LogClock
from services.capture.writer import FileLimits

START_NS = 1_750_000_000 * NS
HOUR_NS = 3600 * NS


class Machine:
    """A machine's two clocks. Each reading takes time, as on a real machine."""

    def __init__(self) -> None:
        self.steady_ns = 77 * NS
        self.ahead_ns = START_NS - self.steady_ns
        self.takes_ns = 100

    def wall(self) -> int:
        return self.steady() + self.ahead_ns

    def steady(self) -> int:
        self.steady_ns += self.takes_ns
        return self.steady_ns

    def passes(self, seconds: float) -> None:
        self.steady_ns += round(seconds * NS)


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.mark.parametrize("by_s", [-3600.0, -0.5, 0.5, 3600.0])
def test_log_time_goes_on_through_a_step_of_the_wall_clock_and_the_step_is_told_once(
    machine: Machine, by_s: float
) -> None:
    clock = LogClock(machine.wall, machine.steady)
    machine.passes(10.0)
    assert clock.look() is None
    before_ns = clock.now_ns()
    machine.ahead_ns += round(by_s * NS)
    machine.passes(1.0)
    assert clock.now_ns() - before_ns == pytest.approx(NS, abs=10_000)
    step = clock.look()
    assert step is not None
    assert step.by_s == pytest.approx(by_s, abs=1e-5)
    assert step.log_ns == pytest.approx(START_NS + 11 * NS, abs=10_000)
    assert clock.look() is None
    assert json.loads(clock.metadata()["steps"]) == [{"log_ns": step.log_ns, "by_s": step.by_s}]
    wall_ns = clock.now_ns() + float(clock.metadata()["ahead_of_log_s"]) * NS
    assert wall_ns == pytest.approx(machine.wall(), abs=10_000)


def test_a_step_back_and_forth_is_two_steps(machine: Machine) -> None:
    clock = LogClock(machine.wall, machine.steady)
    told = []
    for by_ns in (-HOUR_NS, HOUR_NS):
        machine.ahead_ns += by_ns
        told.append(clock.look())
    assert [round(step.by_s) for step in told if step is not None] == [-3600, 3600]
    assert float(clock.metadata()["ahead_of_log_s"]) == pytest.approx(0.0, abs=1e-5)


def test_a_machine_that_sleeps_sets_no_clock(machine: Machine) -> None:
    clock = LogClock(machine.wall, machine.steady)
    machine.passes(8 * 3600.0)
    assert clock.look() is None
    assert clock.now_ns() == pytest.approx(machine.wall(), abs=10_000)


def test_readings_that_were_torn_apart_say_nothing_and_the_next_ones_do(machine: Machine) -> None:
    clock = LogClock(machine.wall, machine.steady)
    machine.takes_ns = 20 * TOGETHER_NS
    assert clock.look() is None
    machine.takes_ns = 100
    machine.ahead_ns -= NS
    step = clock.look()
    assert step is not None
    assert step.by_s == pytest.approx(-1.0, abs=1e-5)


def test_a_clock_that_is_set_for_ever_takes_bounded_room(machine: Machine) -> None:
    clock = LogClock(machine.wall, machine.steady)
    for _ in range(3 * KEPT_STEPS):
        machine.ahead_ns += NS
        clock.look()
    told = clock.metadata()
    assert (len(json.loads(told["steps"])), told["count"]) == (KEPT_STEPS, str(3 * KEPT_STEPS))
    assert float(told["ahead_of_log_s"]) == pytest.approx(3 * KEPT_STEPS, abs=1e-3)


def test_this_machines_clocks_are_not_set_while_nobody_sets_them() -> None:
    clock = LogClock()
    assert all(clock.look() is None for _ in range(1000))
    assert clock.at(steady_ns()) <= clock.now_ns()


def test_a_capture_tells_in_each_of_its_files_how_the_clock_was_set(machine: Machine, tmp_path: Path) -> None:
    clock = LogClock(machine.wall, machine.steady)
    written = writer(tmp_path, FileLimits(file_s=60.0))
    for n in range(300):
        written.put(entry("base/state", n, log_ns=clock.now_ns()))
        machine.passes(0.5)
        if n == 100:
            machine.ahead_ns -= HOUR_NS
            assert clock.look() is not None
            written.remember(WALL_CLOCK, clock.metadata())
    written.close()
    files = sorted(tmp_path.glob("*.mcap"))
    assert len(files) == 3, "150 s, and a file each minute"
    reports = []
    for path in files:
        with Capture.open(path) as capture:
            reports.append(report(capture))
    assert [f"{key.rate_hz:.2f}" for found in reports for key in found.keys] == ["2.00"] * 3
    for found in reports:
        (step,) = found.metadata[WALL_CLOCK]["steps"]
        assert step["by_s"] == pytest.approx(-3600.0, abs=1e-4)
    assert "set back by 3600.000 s at 50.500 s" in capture_command.text(reports[0])
    assert "set back by 3600.000 s 69.500 s before this file began" in capture_command.text(reports[2])
    times = [record.log_ns for path in files for record in all_of(path)]
    assert times == sorted(times)


def test_info_passes_by_what_another_program_calls_so(tmp_path: Path) -> None:
    written = writer(tmp_path)
    written.remember(WALL_CLOCK, {"steps": "many"})
    written.close()
    with Capture.open(written.file.path) as capture:
        assert "clock " not in capture_command.text(report(capture))


def test_the_run_that_goes_on_is_the_newest_though_the_clock_was_set_back_before_it_began(tmp_path: Path) -> None:
    before, now = datetime(2026, 1, 1, 12, tzinfo=UTC), datetime(2026, 1, 1, 11, tzinfo=UTC)
    names = [file_name("calliope", before, 1), *(file_name("calliope", now, n) for n in (999, 1000))]
    for name in names:
        (tmp_path / name).write_bytes(bytes(1000))
    assert [path.name for path in make_room(tmp_path, "calliope", 2000, now).gone] == names[:1]
    assert [path.name for path in make_room(tmp_path, "calliope", 1000, now).gone] == names[1:2]
    assert make_room(tmp_path, "calliope", 0, now).gone == []
    assert [path.name for path in captures(tmp_path, "calliope")] == names[2:]
