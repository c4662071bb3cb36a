"""Processes that wait for a processor and that use it, by a /proc of the test's own; and the rates that are meant."""

from __future__ import annotations

from pathlib import Path

import pytest

from cocoro.topics import ARM_COMMAND, FRAME, LATCH, MODEL
from deploy import processor
from deploy.processor import ProcessorWatch, start_of
from deploy.rates import meant_hz, off


class Proc:
    """A /proc, and the clock of who reads it."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = path
        self.now_s = 100.0
        monkeypatch.setattr("deploy.processor.time.monotonic", lambda: self.now_s)

    def has(
        self, pid: int, name: str, *, cpu_s: float, waited_s: float = 0.0, state: str = "R", start: int = 7
    ) -> None:
        folder = self.path / str(pid)
        folder.mkdir(exist_ok=True)
        ticks = round(cpu_s * processor.TICK_HZ)
        zeros = " ".join(["0"] * 10)
        (folder / "stat").write_text(f"{pid} (a ) b) {state} {zeros} {ticks} 0 0 0 0 0 0 0 {start} 0 0")
        (folder / "schedstat").write_text(f"0 {round(waited_s * 1e9)} 3")
        (folder / "cmdline").write_bytes(f"/somewhere/bin/{name}".replace(" ", "\0").encode())


@pytest.fixture
def proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Proc:
    return Proc(tmp_path, monkeypatch)


def test_it_names_who_waited_and_who_took_the_processor(proc: Proc) -> None:
    watch = ProcessorWatch(proc.path)
    robot = {"planning": 10, "executive": 11}
    proc.has(10, "planner", cpu_s=1.0, waited_s=2.0)
    proc.has(11, "executive", cpu_s=1.0, waited_s=2.0)
    proc.has(20, "python /else/where/loop.py now", cpu_s=50.0)
    assert watch.take(robot) is None
    proc.now_s += 10.0
    proc.has(10, "planner", cpu_s=3.0, waited_s=6.0)
    proc.has(11, "executive", cpu_s=1.1, waited_s=2.5)
    proc.has(20, "python /else/where/loop.py now", cpu_s=57.0)
    use = watch.take(robot)
    assert use is not None
    assert use.waited == pytest.approx({"planning": 0.4, "executive": 0.05})
    assert use.starved == ["planning"]
    assert [(taker.pid, taker.what) for taker in use.takers] == [(20, "python loop.py now"), (10, "planning")]
    assert "of 10 s waited planning 40%" in use.words
    assert "python loop.py now (pid 20) 70%" in use.words


def test_of_a_machine_with_room_nothing_is_said(proc: Proc) -> None:
    watch = ProcessorWatch(proc.path)
    proc.has(10, "planner", cpu_s=1.0, waited_s=2.0)
    watch.take({"planning": 10})
    proc.now_s += 10.0
    proc.has(10, "planner", cpu_s=9.0, waited_s=2.1)
    use = watch.take({"planning": 10})
    assert use is not None
    assert (use.starved, use.words) == ([], "")


def test_without_proc_nothing_is_known(tmp_path: Path) -> None:
    watch = ProcessorWatch(tmp_path / "none")
    assert [watch.take({"planning": 10}), watch.take({"planning": 10})] == [None, None]
    assert start_of(10, tmp_path / "none") is None


def test_a_process_that_ended_has_no_start_time_even_before_it_is_reaped(proc: Proc) -> None:
    proc.has(10, "planner", cpu_s=1.0, start=77)
    assert start_of(10, proc.path) == 77
    proc.has(10, "planner", cpu_s=1.0, start=77, state="Z")
    assert start_of(10, proc.path) is None


def test_the_cameras_rate_is_the_profiles_and_the_others_are_the_tables() -> None:
    resolved = {"processes": ["sim", "planning"], "service": {"sim": {"frame_rate_hz": 15}}}
    assert [meant_hz(topic, resolved) for topic in (FRAME, ARM_COMMAND, LATCH, MODEL, None)] == [15, 50, 5, None, None]
    assert meant_hz(FRAME, {}) == 30.0


@pytest.mark.parametrize(
    ("rate_hz", "words"), [(50.0, ""), (57.0, ""), (61.0, "faster"), (42.0, "slower"), (0.0, "slower")]
)
def test_a_rate_is_off_from_a_share_on(rate_hz: float, words: str) -> None:
    assert off(rate_hz, 50.0) == (f"{words} than meant" if words else "")
    assert off(rate_hz, None) == ""
