"""The wall clock is stepped, both ways, in every process of a robot: nothing at all changes.

In virtual time for the services that run there; by real processes for the base, its guard, the supervisor and the mesh.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from operator_shell import PATIENCE_S, Running
from places import short_folder
from robot_rig import RobotRig
from wall_clock import NoPreloadError, WallClock
from wire_base import MS, Bench

from cocoro import topics
from cocoro.clock import NS, RealClock
from cocoro.vloop import run_virtual
from deploy import robot_time
from deploy.rundir import RunDir, Target

STEPS_S = (-0.01, 0.01, -0.3, 0.3, -0.49, 0.49, -10.0, 10.0, -3600.0, 3600.0, -36_000.0, 36_000.0)
DEADMAN_S = 0.15

# --- the whole robot, in virtual time ---------------------------------------------------------------


class WallTime:
    """Stands in for the machine's clocks in this process: the steady one is the loop's time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ahead_ns = 1_800_000_000 * NS
        self.asked = 0
        monkeypatch.setattr(time, "clock_gettime_ns", self._clock_gettime_ns)
        monkeypatch.setattr(time, "time_ns", self._wall_ns)
        monkeypatch.setattr(time, "time", lambda: self._wall_ns() / NS)

    def _clock_gettime_ns(self, which: int) -> int:
        assert which == time.CLOCK_BOOTTIME
        return round(asyncio.get_running_loop().time() * NS)

    def _wall_ns(self) -> int:
        self.asked += 1
        return round(asyncio.get_running_loop().time() * NS) + self.ahead_ns


async def _fetch(wall: WallTime, steps_s: tuple[float, ...]) -> tuple[str, float, list[float]]:
    """A fetch on the real clock, with the wall clock stepped every 0.4 s; outcome, seconds, the body's speeds."""

    async def step(rig: RobotRig) -> None:
        while steps_s:
            for step_s in steps_s:
                await asyncio.sleep(0.4)
                wall.ahead_ns += round(step_s * NS)

    async with RobotRig(clock_of=lambda _: RealClock(0)) as rig:
        rig.operator.spawn(step(rig))
        state = await rig.run("fetch", "red_can")
        assert rig.held("red_can")
        rejected = [
            port.last_error
            for service in ("base", "arm", "hand", "perception", "planning", "executive")
            for port in rig.tap.messages(topics.HEALTH.of(service))[-1].topics
            if port.rejected
        ]
        assert rejected == []
        return state.outcome or "", state.elapsed_s, rig.speeds_since(0.0)


@pytest.mark.sim
def test_a_fetch_is_the_same_however_the_wall_clock_is_stepped_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    undisturbed = run_virtual(_fetch(WallTime(monkeypatch), ()))
    assert undisturbed[0] == "done"
    assert run_virtual(_fetch(WallTime(monkeypatch), STEPS_S)) == undisturbed


# --- real processes ---------------------------------------------------------------------------------


@pytest.fixture
def wall(tmp_path: Path) -> Iterator[WallClock]:
    try:
        clock = WallClock(tmp_path)
    except NoPreloadError as error:
        pytest.skip(str(error))
    with clock:
        yield clock


class Driven:
    """A robot that is a base on an emulated line, under its supervisor, and a planner in a separate process."""

    def __init__(self, bench: Bench, wall: WallClock, root: Path, folder: Path) -> None:
        self.bench = bench
        self.wall = wall
        self.run_dir = RunDir("stepped", root)
        self._env = os.environ | wall.env | {"COCORO_RUN_DIR": str(root)}
        self._profile = folder / "stepped.toml"
        self._profile.write_text(
            f'robot = "stepped"\nclock = "real"\nprocesses = ["base"]\n[service.base]\nport = "{bench.port}"\n'
        )
        self._planner: subprocess.Popen[bytes] | None = None

    def up(self) -> None:
        self.supervisor = Running([sys.executable, "-m", "apps.cli.main", "up", str(self._profile)], self._env)
        self.supervisor.until("is up")

    def down(self) -> None:
        self.kill_planner()
        if hasattr(self, "supervisor") and self.supervisor.process.poll() is None:
            self.supervisor.end(signal.SIGINT)

    def drive(self) -> None:
        """Start a planner, and wait until the wheels turn."""
        script = Path(__file__).with_name("drive_on_mesh.py")
        self._planner = subprocess.Popen([sys.executable, str(script), "stepped"], env=self._env)
        self.bench.until_wheels(200, 200)

    def kill_planner(self) -> None:
        if self._planner is not None:
            self._planner.kill()
            self._planner.wait()
            self._planner = None

    def kill_base(self) -> None:
        target = Target(self.run_dir.path / "claims" / "base")
        assert target.pid is not None
        target.signal(signal.SIGKILL)
        target.close()

    def rolls(self, way_m: float = 0.1) -> None:
        """Wait until it has come on by so much: half a second of driving."""
        begin_m = self.bench.emulator.call(lambda: self.bench.body.rolled_m[0])
        self.bench.emulator.until(lambda: self.bench.body.rolled_m[0] > begin_m + way_m)

    def interrupted(self, step_s: float) -> bool:
        """Whether the wheels did anything but turn on when the wall clock is set to this."""
        self.bench.forget()
        self.wall.step_to(step_s)
        self.rolls()
        return bool(self.bench.emulator.call(lambda: list(self.bench.create.acted)))

    def python(self, code: str) -> Any:
        """Run Python code in the robot's environment; returns its JSON output."""
        out = subprocess.run([sys.executable, "-c", code], env=self._env, capture_output=True, timeout=PATIENCE_S)
        return json.loads(out.stdout)

    def command(self, *arguments: str) -> tuple[int, str]:
        command = [sys.executable, "-m", "apps.cli.main", *arguments, "--robot", "stepped"]
        done = subprocess.run(command, env=self._env, capture_output=True, text=True, timeout=PATIENCE_S)
        return done.returncode, done.stdout

    def rejected(self) -> list[tuple[str, str]]:
        """Rejected topics with the reasons, by `cocoro top`."""
        code, out = self.command("top", "--once", "--json")
        assert code == 0, out
        readers = [(topic["topic"], reader) for topic in json.loads(out)["topics"] for reader in topic["readers"]]
        assert "base/command" in {topic for topic, _ in readers}
        return [(topic, reader["last_error"]) for topic, reader in readers if reader["rejected"]]


@contextmanager
def driven(wall: WallClock, folder: Path) -> Iterator[Driven]:
    root = short_folder()
    try:
        with Bench(folder) as bench:
            robot = Driven(bench, wall, root, folder)
            try:
                robot.up()
                yield robot
            finally:
                robot.down()
    finally:
        shutil.rmtree(root)


@pytest.mark.process
@pytest.mark.zenoh
def test_the_stepped_clock_steps_wall_time_alone(wall: WallClock) -> None:
    code = (
        "import time, json; print(json.dumps([time.time(), time.monotonic(), time.clock_gettime(time.CLOCK_BOOTTIME)]))"
    )

    def read() -> list[float]:
        out = subprocess.run([sys.executable, "-c", code], env=os.environ | wall.env, capture_output=True, check=True)
        found: list[float] = json.loads(out.stdout)
        return found

    before = read()
    wall.step_to(-36_000.0)
    after = read()
    assert -36_000 < after[0] - before[0] < -35_000
    assert all(0 < b - a < 100 for a, b in zip(before[1:], after[1:], strict=True))


@pytest.mark.process
@pytest.mark.zenoh
@pytest.mark.alone
def test_steps_of_the_wall_clock_disturb_no_drive_and_lengthen_no_deadman(wall: WallClock, tmp_path: Path) -> None:
    with driven(wall, tmp_path) as robot:
        robot.drive()
        robot.rolls()
        for step_s in STEPS_S:
            # A busy machine may be late once; a clock that matters is so each time.
            assert not all(robot.interrupted(sign * step_s) for sign in (1.0, -1.0, 1.0)), step_s
        assert robot.rejected() == []

        def outlives_the_planner(step_s: float) -> bool:
            wall.step_to(0.0)
            robot.bench.forget()
            killed_ns = time.monotonic_ns()
            robot.kill_planner()
            wall.step_to(step_s)
            late = robot.bench.until_wheels(0, 0) - killed_ns >= DEADMAN_S * NS + 100 * MS
            robot.drive()  # messages of a planner that starts after the step are accepted immediately
            return late

        for step_s in (-0.3, -0.49, 0.49, -36_000.0, 36_000.0):
            assert not all(outlives_the_planner(step_s) for _ in range(3)), step_s
        assert robot.rejected() == []


@pytest.mark.process
@pytest.mark.zenoh
@pytest.mark.alone
def test_a_process_that_is_started_again_after_a_step_has_the_robot_s_time(wall: WallClock, tmp_path: Path) -> None:
    with driven(wall, tmp_path) as robot:
        fixed = (robot.run_dir.path / robot_time.FILE).read_bytes()
        robot.drive()
        for step_s in (-36_000.0, 36_000.0):
            wall.step_to(step_s)
            robot.kill_base()
            robot.bench.until_wheels(0, 0)
            robot.bench.until_wheels(200, 200)
            robot.rolls()
        assert robot.rejected() == []
        assert (robot.run_dir.path / robot_time.FILE).read_bytes() == fixed
        code, out = robot.command("status", "--json")
        assert code == 0
        assert abs(json.loads(out)["base"]["stamp_ns"] / NS - time.time()) < 60, "stamps still read as wall time"
