"""The reasons given for silent services. A process that was itself asleep blames no other."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from cocoro.clock import NS
from cocoro.testing import in_virtual_time
from deploy.contact import BEAT_S, LATE_S, RECOVERY_S, ProcessContact, SleepDetector
from deploy.processes import named
from deploy.rundir import RunDir
from deploy.supervised_process import SupervisedProcess

LOST = "lost contact with perception: no sign of it on the mesh, though its process 4711 lives"


class Steady:
    """Boot time, of a machine that a test puts to sleep; otherwise it goes with the loop."""

    def __init__(self) -> None:
        self.slept_s = 0.0

    def __call__(self) -> int:
        return round((asyncio.get_running_loop().time() + self.slept_s) * NS)


class Kept:
    """A sleep detector that runs, and what it reported."""

    def __init__(self) -> None:
        self.steady = Steady()
        self.told: list[str] = []
        self.sleep_detector = SleepDetector(self.told.append, self.steady)
        self.keeping = asyncio.ensure_future(self.sleep_detector.keep())


@in_virtual_time
async def test_a_sleep_is_told_once_and_is_an_excuse_until_connections_are_made_anew() -> None:
    it = Kept()
    await asyncio.sleep(60.0)
    assert (it.sleep_detector.look(), it.told) == ("", [])
    it.steady.slept_s += 15.0
    words = "this machine was asleep or starved for 15 s"
    assert it.sleep_detector.look() == words, "before its own check"
    await asyncio.sleep(RECOVERY_S - 1.0)
    assert it.sleep_detector.look() == words
    await asyncio.sleep(2.0)
    assert (it.sleep_detector.look(), it.told) == ("", [words])
    it.steady.slept_s += 3.0
    await asyncio.sleep(1.0)
    assert it.told == [words, "this machine was asleep or starved for 3 s"]
    it.keeping.cancel()


@in_virtual_time
async def test_a_busy_machine_is_not_asleep() -> None:
    it = Kept()
    for _ in range(100):
        it.steady.slept_s += LATE_S - BEAT_S
        await asyncio.sleep(BEAT_S)
    assert (it.sleep_detector.look(), it.told) == ("", [])
    it.keeping.cancel()


@in_virtual_time
async def test_without_a_run_directory_nobody_is_known_to_be_dead() -> None:
    contact = ProcessContact()
    contact.met("base")
    assert not contact.dead("base")
    assert await contact.lost("base") == "lost contact with base"


def test_one_of_another_machine_is_never_known_to_be_dead(tmp_path: Path) -> None:
    run_dir = RunDir("calliope", tmp_path)
    (claim,) = run_dir.claim("base", ["base"])  # once it ran here
    claim.release()

    @in_virtual_time
    async def scenario() -> None:
        contact = ProcessContact(run_dir.claimant_pid)
        contact.met("base")
        assert not contact.dead("base")
        assert await contact.lost("base") == "lost contact with base"

    scenario()


def test_one_that_is_met_again_lives_again(tmp_path: Path) -> None:
    run_dir = RunDir("calliope", tmp_path)
    contact = ProcessContact(run_dir.claimant_pid)
    (first,) = run_dir.claim("base", ["base"])
    contact.met("base")
    first.release()
    assert contact.dead("base")
    (second,) = run_dir.claim("base", ["base"])
    contact.met("base")
    assert not contact.dead("base")
    second.release()


def test_a_run_directory_that_cannot_be_read_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = RunDir("calliope", tmp_path)
    contact = ProcessContact(run_dir.claimant_pid)
    (claim,) = run_dir.claim("base", ["base"])
    contact.met("base")

    def full(_: str) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(run_dir, "claimant", full)
    assert not contact.dead("base")
    contact.met("base")
    assert not contact.dead("base")
    claim.release()


# --- the supervisor's words -------------------------------------------------------------------------


class Watched:
    """A child that is ready, and whose process lives, as far as its supervisor knows."""

    def __init__(self, folder: Path) -> None:
        self.kept = Kept()
        self.told: list[str] = []
        detector = self.kept.sleep_detector
        self.child = SupervisedProcess(named("perception"), RunDir("calliope", folder), 0, self.told.append, detector)
        self.child._process = _Process()  # type: ignore[assignment]
        self.child.on_alive("perception", True)
        self.child._report_ready()
        self.told.clear()


class _Process:
    pid = 4711


@pytest.mark.parametrize("back", [True, False])
def test_a_supervisor_that_was_itself_asleep_calls_nobody_silent_who_comes_back(back: bool, tmp_path: Path) -> None:
    @in_virtual_time
    async def scenario() -> None:
        it = Watched(tmp_path)
        it.kept.steady.slept_s += 15.0
        it.child.on_alive("perception", False)
        await asyncio.sleep(2.0)
        if back:
            it.child.on_alive("perception", True)
        await asyncio.sleep(3 * RECOVERY_S)
        assert it.told == ([] if back else [LOST])
        it.child.on_alive("perception", True)
        assert it.told[1:] == ([] if back else ["perception is back"])
        it.kept.keeping.cancel()

    scenario()


def test_a_supervisor_that_was_awake_says_at_once_who_is_silent(tmp_path: Path) -> None:
    @in_virtual_time
    async def scenario() -> None:
        it = Watched(tmp_path)
        await asyncio.sleep(60.0)
        it.child.on_alive("perception", False)
        it.child.on_alive("perception", True)
        assert it.told == [LOST, "perception is back"]
        it.kept.keeping.cancel()

    scenario()
