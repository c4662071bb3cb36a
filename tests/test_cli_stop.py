"""`cocoro stop`: what it says, and that it is the truth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

from apps.cli import estop, exits
from apps.cli.estop import _left_open, _merged
from apps.cli.main import main
from apps.cli.stop_result import StopResult
from cocoro.stop.path import StopPoint, listen
from deploy.rundir import RunDir


class Services:
    """Services of a robot that can be stopped, in this process."""

    def __init__(self, stack: ExitStack) -> None:
        self.robot = f"robot-{os.urandom(4).hex()}"
        self.halted: list[str] = []
        self._stack = stack

    def __call__(self, *services: str, hears: bool = True, not_kept: str = "", disk: Future[str] | None = None) -> None:
        for service in services:
            point = StopPoint(self.robot, service)
            self._stack.callback(point.close)
            if hears:
                listen(point, partial(self._halt, service), lambda _: disk or told(not_kept))

    def _halt(self, service: str, _by: str) -> None:
        self.halted.append(service)


def told(text: str) -> Future[str]:
    done: Future[str] = Future()
    done.set_result(text)
    return done


@pytest.fixture
def services(root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    """There is no mesh to be asked beside them."""
    monkeypatch.setattr(estop, "ACKNOWLEDGE_S", 5.0)
    with ExitStack() as stack:
        yield Services(stack)


def test_it_names_who_acknowledged(services: Services, capsys: pytest.CaptureFixture[str]) -> None:
    services("hand", "executive", "base", "arm")
    assert main(["stop", "--robot", services.robot]) == exits.DONE
    said = capsys.readouterr()
    assert said.out.startswith(f"{services.robot}: stopped base, arm, hand, executive in ")
    assert said.out.endswith(" s\n")
    assert said.err == ""
    assert sorted(services.halted) == ["arm", "base", "executive", "hand"]


def test_it_names_who_is_not_there(services: Services, capsys: pytest.CaptureFixture[str]) -> None:
    services("base")
    assert main(["stop", "--robot", services.robot]) == exits.DONE
    assert "; not there: arm, hand\n" in capsys.readouterr().out


def test_it_names_who_is_there_and_says_nothing_and_exits_with_1(
    services: Services, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop, "ACKNOWLEDGE_S", 0.1)
    services("base", "hand")
    services("arm", hears=False)
    assert main(["stop", "--robot", services.robot]) == exits.FAILED
    assert "stopped base, hand in" in (said := capsys.readouterr().err)
    assert "NOT ACKNOWLEDGED by arm" in said
    assert sorted(services.halted) == ["base", "hand"]


def test_an_executive_that_says_nothing_moves_nothing(
    services: Services, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop, "ACKNOWLEDGE_S", 0.1)
    services("base", "arm", "hand")
    services("executive", hears=False)
    assert main(["stop", "--robot", services.robot]) == exits.DONE
    assert "stopped base, arm, hand in" in capsys.readouterr().out


def test_it_says_which_latches_a_restart_will_forget(services: Services, capsys: pytest.CaptureFixture[str]) -> None:
    services("base", "arm", "hand", not_kept="/var/latch: No space left on device")
    assert main(["stop", "--robot", services.robot]) == exits.DONE
    assert "; A RESTART WILL FORGET IT: /var/latch: No space left on device\n" in capsys.readouterr().out


def test_as_data_it_has_the_moment_at_which_each_was_stopped(
    services: Services, capsys: pytest.CaptureFixture[str]
) -> None:
    services("base", "arm", "hand")
    assert main(["stop", "--robot", services.robot, "--json"]) == exits.DONE
    told = json.loads(capsys.readouterr().out)
    assert (told["robot"], told["acknowledged"], told["missing"]) == (services.robot, ["base", "arm", "hand"], [])
    assert set(told["latched_ns"]) == {"base", "arm", "hand"}
    assert told["seconds"] >= 0


def test_help_stops_nothing(services: Services, capsys: pytest.CaptureFixture[str]) -> None:
    services("base")
    assert main(["stop", "--help"]) == exits.DONE
    assert "other users'" in capsys.readouterr().out
    assert main(["stop", "--now"]) == exits.USAGE
    assert services.halted == []


def test_a_site_that_cannot_be_read_is_told_in_a_line(services: Services, capsys: pytest.CaptureFixture[str]) -> None:
    services("base")
    assert main(["stop", "--site", "/nowhere"]) == exits.FAILED
    assert "cocoro: there is no site /nowhere" in capsys.readouterr().err
    assert services.halted == ["base"], "the robots of this machine are stopped all the same"


def test_where_the_kernel_does_not_list_its_sockets_the_mesh_is_asked_and_that_is_said(
    services: Services, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cocoro.stop.asking.SOCKETS", "/nowhere/unix")
    assert main(["stop", "--robot", services.robot]) == exits.NO_MESH
    said = capsys.readouterr().err
    assert "the mesh alone was asked" in said
    assert f"no {services.robot} is up on this machine" in said


def test_what_either_way_acknowledged_is_stopped() -> None:
    path = StopResult("robbie", ("base",), ("arm",), ("hand",), 0.1)
    mesh = StopResult("robbie", ("arm", "hand"), (), (), 0.4)
    (both,) = _merged([path], [mesh])
    assert (both.acknowledged, both.missing, both.absent, both.seconds) == (("base", "arm", "hand"), (), (), 0.4)
    assert both.code == exits.DONE
    assert _merged([path], []) == [path]
    assert _merged([], [mesh]) == [mesh]
    foreign = path._replace(owner=1001)
    assert _merged([foreign], [mesh]) == [foreign, mesh], "a robot of the same name that is another's is another"


def test_a_robot_of_which_nothing_that_moves_answered_is_none() -> None:
    assert StopResult("robbie", ("executive",), (), ("base", "arm", "hand"), 0.1).code == exits.NO_MESH
    assert "(of user 1001)" in str(StopResult("robbie", ("base",), (), (), 0.1, owner=1001))


def test_what_others_robots_answer_says_nothing_about_ones_own(root: Path) -> None:
    run_dir = RunDir("robbie", root)
    run_dir.make()
    foreign = StopResult("robbie", ("base", "arm", "hand"), (), (), 0.1, owner=1001)
    assert _left_open(None, [foreign]) == set()
    run_dir.hold_supervisor("sim")
    (claim,) = run_dir.claim("base", ("base",))
    try:
        assert _left_open(None, [foreign]) == {"robbie"}
        assert _left_open("robbie", [foreign]) == {"robbie"}
        assert _left_open("other", [foreign]) == set()
        assert _left_open(None, [foreign._replace(owner=None)]) == set()
        assert _left_open(None, [StopResult("robbie", ("arm",), (), ("base",), 0.1)]) == {"robbie"}
    finally:
        claim.release()


def test_what_neither_way_acknowledged_is_missing() -> None:
    path = StopResult("robbie", ("arm",), (), ("base", "hand"), 0.1)
    mesh = StopResult("robbie", ("arm",), ("base",), ("hand",), 0.4, ("the disk is full",))
    (both,) = _merged([path], [mesh])
    assert both.not_kept == ("the disk is full",)
    assert (both.missing, both.absent, both.code) == (("base",), ("hand",), exits.FAILED)


def test_it_does_not_exit_with_0_where_a_process_of_ones_own_is_there_and_cannot_be_asked(
    services: Services, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    services("arm", "hand")
    run_dir = RunDir(services.robot, root)
    run_dir.make()
    (claim,) = run_dir.claim("base", ("base",))
    run_dir.hold_supervisor("sim")
    try:
        assert main(["stop", "--robot", services.robot]) == exits.FAILED
    finally:
        claim.release()
    assert "stopped arm, hand in" in (said := capsys.readouterr()).out + said.err


def test_a_mesh_that_fails_in_a_way_of_which_nobody_thought_leaves_told_what_was_stopped(
    services: Services, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out of order")

    monkeypatch.setattr(estop, "ACKNOWLEDGE_S", 0.1)
    monkeypatch.setattr(estop, "_by_mesh_too", fail)
    services("base", "hand")
    services("arm", hears=False)
    assert main(["stop", "--robot", services.robot]) == exits.FAILED
    assert "stopped base, hand in" in (said := capsys.readouterr().err)
    assert "the mesh could not be asked: RuntimeError: out of order" in said


def test_a_disk_that_has_not_said_anything_yet_is_told(
    services: Services, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop, "KEPT_S", 0.05)
    services("base", disk=Future())
    assert main(["stop", "--robot", services.robot]) == exits.DONE
    assert "; not yet known to be on the disk: base\n" in capsys.readouterr().out


def test_nothing_that_another_process_says_or_calls_itself_reaches_the_terminal_raw(
    services: Services, capsys: pytest.CaptureFixture[str]
) -> None:
    services("base", "arm\x1b[2J", not_kept="\x1b[2Jgone\n")
    main(["stop", "--robot", services.robot])
    said = capsys.readouterr()
    assert "[2Jgone" in said.out + said.err
    assert "\x1b" not in said.out + said.err


@pytest.mark.process
@pytest.mark.parametrize("streams", ["closed", "full"])
def test_who_cannot_be_told_has_stopped_the_robot_all_the_same(services: Services, streams: str) -> None:
    services("base", "arm", "hand")
    to = ">&- 2>&-" if streams == "closed" else ">/dev/full 2>/dev/full"
    command = f"exec {sys.executable} -m apps.cli.main stop --robot {services.robot} {to}"
    code = subprocess.run(["sh", "-c", command], check=False).returncode
    assert code == exits.FAILED
    assert {*services.halted} == {"arm", "base", "hand"}  # a slow one is told again
