"""Which file of tests begins, by the memory that it needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import run_memory
from run_known import LARGE_MB, Known
from run_memory import AGAIN, LEAST_MB, MEMORY, RUNNING, WORKER, Watch, memory_mb
from run_record import FOLDER
from run_room import Room, jobs_of

ROBOT, SMALL = 420.0, 40.0


def item(name: str, *markers: str, fixtures: dict[str, str] | None = None) -> Any:
    """What a test has that matters here; its name begins with its file. `fixtures`: the scope of each."""
    definitions = {name: (SimpleNamespace(scope=scope),) for name, scope in (fixtures or {}).items()}
    marks = [SimpleNamespace(name=marker) for marker in markers]
    closest = {marker: marker for marker in markers}.get
    path = Path(name.partition("::")[0])
    return SimpleNamespace(
        nodeid=name, path=path, iter_markers=lambda: marks, get_closest_marker=closest,
        _fixtureinfo=SimpleNamespace(name2fixturedefs=definitions),
    )  # fmt: skip


def orders(room: Room, *idle: tuple[int, str]) -> list[tuple[int, int]]:
    """Worker and job of all that begin now."""
    left, found = list(idle), []
    while (order := room.next_for(left)) is not None:
        found.append(order)
        left = [one for one in left if one[0] != order[0]]
    return found


def test_without_a_record_a_file_needs_what_is_kept_of_it_or_what_its_most_demanding_test_may_need(
    tmp_path: Path,
) -> None:
    items = [item("a.py::a"), item("a.py::b", "process"), item("b.py::c"), item("b.py::d", "sim")]
    robot, robots = (item(f"{file}::e", "sim", "zenoh", "process") for file in ("c.py", "d.py"))
    pure = item("d.py::pure")
    usual = Known(own_mb={"d.py": 740.0})
    for folder in (None, tmp_path):
        jobs = jobs_of([*items, robot, robots, pure], folder, usual)
        assert [job.items for job in jobs] == [items[:2], items[2:], [robot], [robots], [pure]]
        needs_mb = [job.need_mb for job in jobs]
        assert needs_mb[0] == needs_mb[4] == LEAST_MB
        assert needs_mb[:4] == sorted(set(needs_mb[:4]))
        assert needs_mb[3] == 740.0


def test_what_is_kept_counts_for_files_that_the_record_lacks(tmp_path: Path) -> None:
    (tmp_path / MEMORY).write_text(json.dumps({"own_mb": {"a::a": 300.0}}))
    usual = Known({"b": 9.0}, {"a": 390.0, "b": 200.0, "b::big": LARGE_MB + 1})
    jobs = jobs_of([item("a::a"), item("a::b", "sim"), item("b::a", "sim"), item("b::big", "sim")], tmp_path, usual)
    assert [(job.items[0].nodeid, job.need_mb) for job in jobs] == [
        ("b::a", 200.0), ("b::big", LARGE_MB + 1), ("a::a", 300.0),
    ]  # fmt: skip


def test_of_a_file_in_parts_each_part_counts_as_long_as_it_took_itself(tmp_path: Path) -> None:
    (tmp_path / MEMORY).write_text(json.dumps({"own_mb": {"a::large": LARGE_MB + 1, "a::small": 90.0, "b::a": 90.0}}))
    took_s = {"a::small": 1.0, "a::large": 8.0, "b::a": 5.0}
    run = {"files": {"a": {"wall_s": 9.0}, "b": {"wall_s": 5.0}}, "tests_s": took_s}
    (tmp_path / "pytest-1.json").write_text(json.dumps(run))
    jobs = jobs_of([item("a::small"), item("a::large"), item("b::a")], tmp_path)
    assert [job.items[0].nodeid for job in jobs] == ["a::large", "b::a", "a::small"]


def test_with_a_record_a_file_needs_what_its_most_demanding_test_needed(tmp_path: Path) -> None:
    (tmp_path / MEMORY).write_text(json.dumps({"own_mb": {"a::a": 300.0, "a::b": 100.0, "c::a": 1.0}}))
    (tmp_path / "pytest-1.json").write_text(json.dumps({"files": {"new": {"wall_s": 0.0}}}))  # no look has seen it
    jobs = jobs_of([item("a::b"), item("a::a"), item("c::a"), item("new::a", "sim")], tmp_path)
    assert [job.need_mb for job in jobs] == [300.0, LEAST_MB, LEAST_MB]
    (robot,) = jobs_of([item("new::b", "zenoh", "sim", "process")], tmp_path)
    assert robot.need_mb > LARGE_MB, "it has not run"


def test_what_a_test_needed_before_fades_when_it_needs_less(tmp_path: Path) -> None:
    (tmp_path / "last").mkdir()
    (tmp_path / "last" / MEMORY).write_text(json.dumps({"own_mb": {"a::a": 300.0, "a::b": LEAST_MB + 1}}))
    assert Watch(tmp_path / "new").own_mb == {"a::a": 270.0}


def test_the_large_tests_of_a_file_are_a_job_of_their_own(tmp_path: Path) -> None:
    needs = {"a::a": 300.0, "a::b": LARGE_MB + 50, "a::c": 100.0, "a::d": LARGE_MB + 10}
    (tmp_path / MEMORY).write_text(json.dumps({"own_mb": needs}))
    jobs = jobs_of([item(name) for name in needs], tmp_path)
    assert [([one.nodeid for one in job.items], job.need_mb) for job in jobs] == [
        (["a::a", "a::c"], 300.0), (["a::b", "a::d"], LARGE_MB + 50),
    ]  # fmt: skip


def test_a_file_whose_tests_share_a_fixture_is_one_job(tmp_path: Path) -> None:
    (tmp_path / MEMORY).write_text(json.dumps({"own_mb": {"a::first": LARGE_MB + 50, "b::large": LARGE_MB + 10}}))
    shared = {"robot": "session", "lab": "module"}
    whole = [item("a::first", fixtures=shared), item("a::apart"), item("a::later", fixtures=shared)]
    parts = [item("b::large", fixtures={"robot": "session"}), item("b::quick")]
    jobs = jobs_of([*whole, *parts], tmp_path)
    assert [(job.items, job.need_mb) for job in jobs] == [
        (whole, LARGE_MB + 50), (parts[:1], LARGE_MB + 10), (parts[1:], LEAST_MB),
    ]  # fmt: skip


@pytest.mark.process
def test_what_a_fixture_has_started_is_needed_by_every_test_during_which_it_runs(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    folder.mkdir()
    worker = str(os.getpid())
    (folder / f"{RUNNING}{worker}").write_text("a::later")
    marks = {FOLDER: str(folder), "PYTEST_CURRENT_TEST": "a::first (setup)", WORKER: worker}
    filled = "held = bytearray(60_000_000); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", filled], env=os.environ | marks, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as started:
        assert started.stdout is not None
        started.stdout.readline()
        watch = Watch(folder)
        watch.look()
        started.kill()
    assert watch.own_mb["a::later"] > 60.0
    assert "a::first" not in watch.own_mb
    assert [0 <= idle_s < 3600 for idle_s in watch.idle_s] == [True]
    ((_, _, parts),) = watch.looks
    assert parts["a"] > 60.0


@pytest.mark.process
def test_a_process_is_measured_again_when_it_has_grown_and_otherwise_seldom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[str] = []

    def note(process: Path) -> run_memory.Memory:
        measured.append(process.name)
        return memory_mb(process)

    monkeypatch.setattr(run_memory, "memory_mb", note)
    grows = "held = []\nwhile True: print(flush=True); input(); held.append(bytearray(60_000_000))"
    with subprocess.Popen(
        [sys.executable, "-c", grows], env=os.environ | {FOLDER: str(tmp_path)},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as started:  # fmt: skip
        assert started.stdin is not None
        assert started.stdout is not None
        watch = Watch(tmp_path)
        started.stdout.readline()
        for _ in range(AGAIN):
            watch.look()
        before_mb, times = watch.looks[-1][1], measured.count(str(started.pid))
        started.stdin.write(b"\n")
        started.stdin.flush()
        started.stdout.readline()
        watch.look()
        started.kill()
    assert times == 1
    assert watch.looks[-1][1] > before_mb + 59.0


def test_a_second_robot_waits_and_what_is_small_begins_meanwhile() -> None:
    room = Room({"beside": [(0, ROBOT), (1, ROBOT), (2, SMALL)], "others": [(0, SMALL)]}, budget_mb=700.0)
    assert orders(room, (7, "others"), (8, "beside"), (9, "beside")) == [(8, 0), (9, 2), (7, 0)]
    room.ended(9)
    assert orders(room, (9, "beside")) == []
    room.ended(8)
    assert orders(room, (8, "beside"), (9, "beside")) == [(8, 1)]


def test_what_makes_the_run_longer_when_it_waits_gets_the_room_that_others_leave() -> None:
    waiting = {"beside": [(0, ROBOT)], "others": [(0, 200.0), (1, 200.0), (2, SMALL)]}
    room = Room(waiting, budget_mb=600.0)
    assert orders(room, (1, "others"), (2, "others")) == [(1, 0), (2, 1)]
    assert orders(room, (3, "beside")) == []
    room.ended(1)
    assert orders(room, (1, "others"), (3, "beside")) == [], "a small one would keep the robot from its room"
    room.ended(2)
    assert orders(room, (1, "others"), (2, "others"), (3, "beside")) == [(3, 0), (1, 2)]


def test_others_leave_room_for_the_long_file_that_comes_next() -> None:
    waiting = {"beside": [(0, ROBOT), (1, 100.0), (2, SMALL)], "others": [(0, 200.0), (1, 200.0), (2, SMALL)]}
    room = Room(waiting, budget_mb=600.0)
    room.runs[1] = room.runs[2] = "others", 150.0
    assert orders(room, (3, "beside"), (4, "beside")) == [(3, 1), (4, 2)], "small ones meanwhile"
    room.ended(1)
    assert orders(room, (1, "others")) == [], "the room for the robot, when the smaller one ends"
    room.ended(4)
    assert orders(room, (1, "others"), (4, "beside")) == [], "its room is still taken"
    room.ended(2)
    assert orders(room, (1, "others"), (2, "others"), (4, "beside")) == [(4, 0), (1, 2)]


def test_what_needs_more_than_there_is_begins_when_nothing_else_runs() -> None:
    room = Room({"beside": [(0, 900.0)], "others": [(0, SMALL)]}, budget_mb=600.0)
    room.runs[5] = "others", SMALL
    assert orders(room, (8, "beside")) == []
    room.ended(5)
    assert orders(room, (5, "others"), (8, "beside")) == [(8, 0)]
    room.ended(8)
    assert orders(room, (5, "others"), (8, "beside")) == [(5, 0)]
