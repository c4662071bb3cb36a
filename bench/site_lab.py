"""A site of three hosts on this machine, for trials of several machines: the simulated robot, its brain, an operator.

The hosts are network namespaces (`sim.network`); each has its own credentials, as copied there, and nobody else's. This
process joins the robot's private mesh on its own host as an observer, past the network.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.live import Fetched
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.profiles import read as read_profile
from deploy.rundir import RunDir
from deploy.site import authority, place
from deploy.site.roles import Role
from sim.judge import HELD_S, Judge
from sim.network.network import Host, Network
from sim.random_scene import find_scene

ROBOT = "robbie"
BODY, BRAIN, DESK = "body", "brain", "desk"
"""The hosts; at the desk sit the persons."""
PERSONS: dict[str, Role] = {"ada": "operator", "eve": "viewer", "bob": "author"}
PORT = 7447
COCKPIT_PORT = 8770
"""Of the cockpit, where it is among the processes of the robot's host; then it is open to the other hosts."""
COMMAND_S = 120.0
BRAINS = ("perception", "planning", "executive")
FRAMES: dict[str, Any] = {"width": 320, "height": 240, "frame_rate_hz": 15.0}


def files_of(address: str, sim: Mapping[str, Any], processes: Sequence[str] = ("capture", "sim")) -> dict[str, str]:
    """The plan and the profile, by file name."""
    settings = "".join(f"{key} = {json.dumps(value)}\n" for key, value in sim.items())
    persons = "".join(f'[person.{name}]\nrole = "{role}"\n' for name, role in PERSONS.items())
    return {
        "profile.toml": (
            f'robot = "{ROBOT}"\nclock = "sim"\nprocesses = {json.dumps([*processes, *BRAINS])}\n'
            f"[service.sim]\n{settings}[service.capture]\nkeep_gb = 2.0\n"
            f'[service.cockpit]\nhost = "{address}"\nport = {COCKPIT_PORT}\n'
        ),
        place.PLAN: (
            f'name = "lab"\n[robot.{ROBOT}]\nprofile = "profile.toml"\n'
            f'[host.{BODY}]\nrole = "robot"\nprocesses = {json.dumps(list(processes))}\n'
            f'listen = ["tls/{address}:{PORT}"]\n'
            f'[host.{BRAIN}]\nrole = "brain"\nprocesses = {json.dumps(BRAINS)}\n{persons}'
        ),
    }


class Lab:
    """The site. Make it with `lab`."""

    def __init__(self, network: Network, folder: Path, sim: Mapping[str, Any], processes: Sequence[str]) -> None:
        self.network = network
        self.body, self.brain, self.desk = (network.host(name) for name in (BODY, BRAIN, DESK))
        self.plan = folder / "site"
        self.plan.mkdir(mode=0o700)
        self._write(sim, processes)
        self._issue()
        self.run_dir = RunDir(ROBOT, self.body.folder / "run")

    def _write(self, sim: Mapping[str, Any], processes: Sequence[str]) -> None:
        for name, text in files_of(self.body.address, sim, processes).items():
            (self.plan / name).write_text(text, encoding="utf-8")
        read_profile(str(self.plan / "profile.toml"))

    def _issue(self) -> None:
        now = datetime.now(UTC)
        authority.init(self.plan, now)
        authority.issue(self.plan, "robot", BODY, now, addresses=[self.body.address])
        authority.issue(self.plan, "brain", BRAIN, now)
        for name, role in PERSONS.items():
            authority.issue(self.plan, role, name, now)
        for host, names in ((self.body, (BODY,)), (self.brain, (BRAIN,)), (self.desk, tuple(PERSONS))):
            self.deliver(host, names)

    def deliver(self, host: Host, names: Sequence[str]) -> Path:
        """Copies the plan, the admissions and these credentials to a host; returns its folder of the site."""
        there = self.site_of(host)
        there.mkdir(mode=0o700, exist_ok=True)
        for file in (place.PLAN, place.ADMITTED, "profile.toml"):
            shutil.copy(self.plan / file, there / f".{file}")
            (there / f".{file}").replace(there / file)
        for name in names:
            target = there / place.CREDENTIALS / name
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(self.plan / place.CREDENTIALS / name, target)
            target.chmod(0o700)
            target.parent.chmod(0o700)
        return there

    @staticmethod
    def site_of(host: Host) -> Path:
        return host.folder / "site"

    # --- up and down ------------------------------------------------------------------------------

    def up(self) -> None:
        """Starts both shares. Raises RuntimeError when one does not come up."""
        for host in (self.body, self.brain):
            self.start(host)

    def start(self, host: Host) -> None:
        share = ("up", "--site", str(self.site_of(host)), "--host", host.name, "--detach")
        code, said, _ = self.command(host, *share)
        if code:
            raise RuntimeError(f"{host.name} does not come up: {said}")

    def down(self) -> None:
        for host in (self.brain, self.body):
            self.command(host, "down")

    def command(self, host: Host, *arguments: str, timeout_s: float = COMMAND_S) -> tuple[int, str, float]:
        """Runs a `cocoro` command on a host; returns its exit code, what it said, and its time in seconds."""
        begun_s = time.monotonic()
        process = self.begin(host, *arguments)
        said, _ = process.communicate(timeout=timeout_s)
        return process.returncode, said, time.monotonic() - begun_s

    def begin(self, host: Host, *arguments: str) -> subprocess.Popen[str]:
        argv = [sys.executable, "-m", "apps.cli.main", *arguments]
        return host.run(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def as_person(self, name: str) -> tuple[str, str]:
        """The option of a command at the desk by which a person reaches the robot."""
        return "--site", f"{name}@{self.site_of(self.desk)}"

    def log(self, host: Host, process: str) -> str:
        return RunDir(ROBOT, host.folder / "run").log(process).read_text(errors="replace")

    # --- what happens -----------------------------------------------------------------------------

    @asynccontextmanager
    async def observer(self) -> AsyncIterator[Node]:
        """A participant of the body's private mesh, past the network."""
        async with (
            await ZenohBus.open(self.run_dir.join_as("bench")) as bus,
            Node("bench", bus, FollowedClock(), Robot.load(), robot_name=ROBOT) as node,
        ):
            yield node

    async def fetch(self, label: str = "red_can") -> Fetched:
        """The operator fetches an object; judged a while after the end, so that a slipping can counts as lost."""
        judge = Judge(Robot.load(), find_scene("paper", 0, label), label)
        async with self.observer() as node:
            node.on(topics.TRUTH, judge.feed)
            code, said, seconds = await asyncio.to_thread(
                self.command, self.desk, "fetch", label, *self.as_person("ada")
            )
            await asyncio.sleep(HELD_S + 0.5)
        return Fetched(code, said, seconds, judge.result())


@contextmanager
def lab(folder: Path, *, seed: int = 0, processes: Sequence[str] = ("capture", "sim"), **sim: Any) -> Iterator[Lab]:
    """The site, its network without delay, its processes not started. `sim` are the simulator's settings."""
    with Network(BODY, BRAIN, DESK, seed=seed) as network:
        made = Lab(network, folder, {"scene": "paper", **FRAMES, **sim}, processes)
        try:
            yield made
        finally:
            made.down()
