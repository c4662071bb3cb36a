"""The robot's offset to wall time: fixed once, read by every process that joins, and invalid after a reboot."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from cocoro.clock import NS, wall_offset_ns
from deploy import robot_time
from deploy.robot_time import COMPARED, FILE, OWN, SETTABLE


def step_wall_clock(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    wall_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns() + round(seconds * NS))


def measured_here(offset_ns: int) -> bool:
    """Whether it is the wall clock's offset as it is now."""
    return abs(offset_ns - wall_offset_ns()) < NS // 10


@pytest.mark.parametrize("step_s", [-36_000.0, -0.49, 0.3, 36_000.0])
def test_who_joins_after_a_step_has_the_time_of_who_was_there_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    first = robot_time.fix(tmp_path)
    assert measured_here(first.offset_ns)
    step_wall_clock(monkeypatch, step_s)
    assert robot_time.clock(tmp_path).offset_ns == first.offset_ns
    assert [file.name for file in tmp_path.iterdir()] == [FILE]


def test_the_next_start_of_the_robot_reads_the_wall_clock_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot_time.fix(tmp_path)
    step_wall_clock(monkeypatch, 3600.0)
    assert measured_here(robot_time.fix(tmp_path).offset_ns)
    assert measured_here(robot_time.clock(tmp_path).offset_ns)


@pytest.mark.parametrize("content", [None, b"", b"{", bytes(15), bytes(16), bytes(16) + b"x", bytes(9000)])
def test_who_finds_nothing_that_can_be_read_measures_its_own_and_writes_nothing(
    tmp_path: Path, content: bytes | None
) -> None:
    if content is not None:
        (tmp_path / FILE).write_bytes(content)
    assert measured_here(robot_time.clock(tmp_path).offset_ns)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == ([] if content is None else [content])


def test_an_offset_from_another_boot_is_none(tmp_path: Path) -> None:
    robot_time.fix(tmp_path)
    robot_time.setting(tmp_path).correct(10 * NS)
    file = tmp_path / FILE
    there = file.read_bytes()
    assert robot_time.clock(tmp_path).offset_ns == 10 * NS
    for wrong in (there[:16], there + b"x"):
        fresh = tmp_path / "fresh"
        fresh.write_bytes(wrong)
        fresh.replace(file)
        assert measured_here(robot_time.clock(tmp_path).offset_ns)


def test_clocks_that_were_made_before_see_a_correction(tmp_path: Path) -> None:
    fixed = robot_time.fix(tmp_path, settable=True)
    others = [robot_time.clock(tmp_path) for _ in range(2)]
    setting = robot_time.setting(tmp_path)
    assert setting.settable
    assert robot_time.origin(tmp_path) == SETTABLE
    setting.correct(setting.offset_ns + 3 * NS)
    setting.begin(COMPARED)
    assert {clock.offset_ns for clock in (fixed, *others)} == {setting.offset_ns}
    assert not robot_time.setting(tmp_path).settable
    assert robot_time.origin(tmp_path) == COMPARED


def test_a_robot_s_time_is_its_own_unless_a_gateway_may_set_it(tmp_path: Path) -> None:
    assert robot_time.origin(tmp_path) == OWN, "without a file"
    robot_time.fix(tmp_path)
    assert robot_time.origin(tmp_path) == OWN
    assert not robot_time.setting(tmp_path).settable


def test_a_gateway_without_a_file_fixes_the_time(tmp_path: Path) -> None:
    setting = robot_time.setting(tmp_path)
    assert measured_here(setting.offset_ns)
    assert robot_time.clock(tmp_path).offset_ns == setting.offset_ns


@pytest.mark.process
def test_another_process_sees_a_correction(tmp_path: Path) -> None:
    clock = robot_time.fix(tmp_path)
    if (child := os.fork()) == 0:
        robot_time.setting(tmp_path).correct(7 * NS)
        os._exit(0)
    os.waitpid(child, 0)
    assert clock.offset_ns == 7 * NS


def test_a_robot_that_was_never_up_here_has_no_folder_and_still_a_clock(tmp_path: Path) -> None:
    assert measured_here(robot_time.clock(tmp_path / "nobody").offset_ns)
