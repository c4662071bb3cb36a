"""The robot of the benches `stop` and `stop-restarts`: its namespaces, its directories and its driver."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path

from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.errors import CocoroError
from cocoro.messages import BaseState, ResetRequest
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import RunDir

NAME = "calliope"
CIRCLE = (0.41, 0.29)
"""Wheel speeds for a circle of 0.75 m at 0.35 m/s."""
FULL_MPS = 0.345
PATIENCE_S = 60.0
PROFILE = """
robot = "calliope"
clock = "sim"
processes = ["sim", "perception", "executive", "capture"]
[service.sim]
width = 320
height = 240
frame_rate_hz = 15.0
scene = "{scene}"
"""
SCENE = """
[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [4.0, 4.0]
"""
"""A scene without obstacles."""


def in_namespaces() -> None:
    """Go on in new mount and network namespaces, as a new run of this program. Raises CocoroError for a user who may
    not make them."""
    if os.environ.get("BENCH_STOP_INSIDE"):
        subprocess.run(["mount", "--make-rprivate", "/"], check=True)
        return
    if os.geteuid():
        raise CocoroError("this bench makes namespaces and mounts disks: run it as root")
    command = ["unshare", "--mount", "--net", sys.executable, "-m", "bench", *sys.argv[1:]]
    os.execvpe("unshare", command, os.environ | {"BENCH_STOP_INSIDE": "1"})


class Driver:
    """Replaces the planner: drives on a circle while it is requested."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.state: BaseState | None = None
        self.latched_s = 0.0
        """When this process received it."""
        self._news = asyncio.Event()
        node.on(topics.BASE_STATE, self._hear)
        node.spawn(self._drive())

    def _hear(self, state: BaseState) -> None:
        if state.latch == "latched" and (self.state is None or self.state.latch != "latched"):
            self.latched_s = time.monotonic()
        self.state = state
        self._news.set()

    async def _drive(self) -> None:
        async for _ in self.node.every(50.0):
            self.node.publish(topics.BASE_COMMAND, self.node.robot.drive.command_of(CIRCLE))

    async def until(self, good: Callable[[BaseState], object]) -> BaseState:
        async with asyncio.timeout(PATIENCE_S):
            while self.state is None or not good(self.state):
                self._news.clear()
                await self._news.wait()
        return self.state

    async def reset(self) -> None:
        for _ in range(20):
            await self.node.call_all(topics.RESET.of("*"), ResetRequest(by="bench"), 5.0)
            with suppress(TimeoutError):
                async with asyncio.timeout(3.0):
                    await self.until(lambda state: state.latch == "released" and state.speed_mps > FULL_MPS)
                    return
        raise CocoroError("the robot does not drive")


class Place:
    """The directories of a robot and its commands."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.run_dir = RunDir(NAME, root / "run")
        self.profile = root / "bench.toml"
        (root / "scene.toml").write_text(SCENE)
        self.profile.write_text(PROFILE.format(scene=root / "scene.toml"))
        self.env = os.environ | {
            "COCORO_RUN_DIR": str(root / "run"),
            "COCORO_CAPTURE_DIR": str(root / "captures"),
            "COCORO_STATE_DIR": str(root / "state"),
        }

    def start(self, *arguments: str, env: dict[str, str] | None = None) -> subprocess.Popen[str]:
        command = [str(Path(sys.executable).with_name("cocoro")), *arguments]
        return subprocess.Popen(
            command, env=self.env if env is None else env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def run(self, *arguments: str) -> tuple[int, str]:
        with self.start(*arguments) as process:
            said = process.communicate(timeout=120.0)[0]
        return process.returncode, said

    def up(self, profile: str | None = None, *arguments: str) -> None:
        code, said = self.run("up", profile or str(self.profile), "--detach", *arguments)
        if code:
            raise CocoroError(said)


@contextmanager
def place() -> Iterator[Place]:
    """Directories of a robot on separate disks of 64 MB in memory, so that they can be filled."""
    root = Path(tempfile.mkdtemp(prefix="cs"))
    with ExitStack() as stack:
        stack.callback(lambda: subprocess.run(["rm", "-rf", str(root)], check=False))
        for name, size in (("run", "16M"), ("state", "1M")):
            (root / name).mkdir(mode=0o700)
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size},mode=0700", "none", root / name], check=True)
            stack.callback(lambda folder=root / name: subprocess.run(["umount", "-l", str(folder)], check=False))  # type: ignore[misc]
        here = Place(root)
        stack.callback(lambda: here.run("down"))
        yield here


@asynccontextmanager
async def driving(here: Place) -> AsyncIterator[Driver]:
    async with (
        await ZenohBus.open(here.run_dir.join_as("bench")) as bus,
        Node("planning", bus, FollowedClock(), Robot.load()) as node,
    ):
        driver = Driver(node)
        await driver.until(lambda _: True)
        yield driver
