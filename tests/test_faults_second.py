"""A second process for the same service of the same robot is refused at its start, whenever it comes."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import operator_shell
import pytest
from faults_live import profile_text

from deploy import launch, profiles
from deploy.rundir import RunDir

SIM = "arm,base,hand,kinect"
CONTENDER = Path(__file__).with_name("faults_claims.py")


@pytest.fixture
def run_dir(short_path: Path) -> RunDir:
    return RunDir("robbie", short_path)


class Contender:
    """A process that claims some services on request."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        assert self.says() == "ready"

    def tell(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write("now\n")
        self._process.stdin.flush()

    def says(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextmanager
def contenders(run_dir: RunDir, *services: str) -> Iterator[list[Contender]]:
    with ExitStack() as stack:
        found = []
        for number, names in enumerate(services):
            command = [sys.executable, str(CONTENDER), str(run_dir.root), f"process{number}", names]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            stack.enter_context(process)
            stack.callback(process.kill)
            found.append(process)
        yield [Contender(process) for process in found]


@contextmanager
def looked_at(run_dir: RunDir) -> Iterator[None]:
    """Read the claims continuously, as `cocoro status` and the supervisor do."""
    enough = threading.Event()

    def look() -> None:
        while not enough.is_set():
            run_dir.claims()

    onlooker = threading.Thread(target=look)
    onlooker.start()
    try:
        yield
    finally:
        enough.set()
        onlooker.join()


@pytest.mark.process
@pytest.mark.parametrize("services", [(SIM,), (SIM, SIM), ("executive", "executive"), (SIM, SIM, SIM)])
def test_of_those_that_claim_at_once_exactly_one_gets_it_even_while_somebody_looks(
    run_dir: RunDir, services: tuple[str, ...]
) -> None:
    winners = set()
    with contenders(run_dir, *services) as processes, looked_at(run_dir):
        for _ in range(100):
            for process in processes:
                process.tell()
            said = [process.says() for process in processes]
            assert said.count("won") == 1, said
            assert all("robbie has a" in text for text in said if text != "won")
            winners.add(said.index("won"))
            for process in processes:
                process.tell()
            assert [process.says() for process in processes] == ["over"] * len(processes)
    assert run_dir.claims() == {}


@pytest.mark.process
def test_a_simulator_and_the_hardware_it_stands_in_for_never_run_side_by_side(run_dir: RunDir) -> None:
    with contenders(run_dir, SIM, "base", "arm,hand") as processes, looked_at(run_dir):
        for _ in range(100):
            for process in processes:
                process.tell()
            sim, base, servos = (process.says() == "won" for process in processes)
            assert not (sim and (base or servos))
            for process in processes:
                process.tell()
            assert [process.says() for process in processes] == ["over"] * 3


@pytest.mark.process
@pytest.mark.zenoh
@pytest.mark.parametrize(("process", "first"), [("executive", "executive"), ("sim", "arm")])
def test_of_two_that_start_at_once_one_runs_and_one_is_refused_in_a_line(
    run_dir: RunDir, tmp_path: Path, process: str, first: str
) -> None:
    profile = tmp_path / "robbie.toml"
    profile.write_text(profile_text("robbie", {"width": 64, "height": 48}))
    run_dir.make()
    run_dir.profile_file.write_bytes(msgspec.json.encode(profiles.read(str(profile))))
    command = [sys.executable, "-m", "deploy.launch", process, "--run-dir", str(run_dir.path)]
    for _ in range(10):
        with ExitStack() as stack:
            both = []
            for _ in range(2):
                started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
                stack.enter_context(started)
                stack.callback(started.kill)
                both.append(started)
            refused = first_to_end(both)
            lines = refused.communicate()[0].splitlines()
            assert refused.returncode == launch.REFUSED, lines
            (runs,) = (started for started in both if started is not refused)
            assert runs.poll() is None
            assert f"robbie has an {first} already ({process}, pid {runs.pid}): stop that one first" in lines[-1]
            assert not any("Traceback" in line for line in lines)
            assert run_dir.claims()[first].pid == runs.pid


def first_to_end(processes: list[subprocess.Popen[str]]) -> subprocess.Popen[str]:
    ended = threading.Event()

    def wait(process: subprocess.Popen[str]) -> None:
        process.wait()
        ended.set()

    waiting = [threading.Thread(target=wait, args=(process,), daemon=True) for process in processes]
    for thread in waiting:
        thread.start()
    assert ended.wait(operator_shell.PATIENCE_S)
    return next(process for process in processes if process.poll() is not None)


class Inner(msgspec.Struct, frozen=True):
    speed_mps: float = 1.0


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    port: str
    rate_hz: float = 2.0
    inner: Inner = Inner()


def test_a_start_logs_the_settings_that_differ_and_those_without_a_default() -> None:
    assert launch.changed(Settings(port="a", inner=Inner(speed_mps=0.5))) == ['port = "a"', "inner.speed_mps = 0.5"]
