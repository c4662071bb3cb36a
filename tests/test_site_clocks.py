"""Two hosts of a site as real processes, with clocks that have nothing in common: their robot's time is one."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from operator_shell import PATIENCE_S, Running
from places import in_short_folder
from wall_clock import NoPreloadError, WallClock

from cocoro.clock import NS
from deploy import robot_time
from deploy.site import authority

pytestmark = [pytest.mark.process, pytest.mark.zenoh, pytest.mark.alone]
ROBOT = "paired"
STARTED_S = 40_000.0
"""The machine of `brain` seems to have run for so much longer."""
WRONG_S = 3.0
"""Its wall clock is ahead by this."""
COCORO = [sys.executable, "-m", "apps.cli.main"]
UNSHARE = ["unshare", "-T", "--monotonic", f"{STARTED_S:.0f}", "--boottime", f"{STARTED_S:.0f}"]


@pytest.fixture
def wall(tmp_path: Path) -> Iterator[WallClock]:
    tried = subprocess.run([*UNSHARE, "true"], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"no time namespace here: {tried.stderr.strip()}")
    try:
        clock = WallClock(tmp_path)
    except NoPreloadError as error:
        pytest.skip(str(error))
    with clock:
        clock.step_to(WRONG_S)
        yield clock


class Hosts:
    """The site and its hosts' run directories."""

    def __init__(self, root: Path, wall: WallClock) -> None:
        self.root = root
        self.site = root / "site"
        self.site.mkdir(mode=0o700)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        (self.site / "profile.toml").write_text(
            f'robot = "{ROBOT}"\nclock = "real"\nprocesses = ["capture", "executive"]\n'
            f'[service.capture]\nfolder = "{root / "captures"}"\n'
        )
        (self.site / "site.toml").write_text(
            f'name = "lab"\n[robot.{ROBOT}]\nprofile = "profile.toml"\n'
            f'[host.body]\nrole = "robot"\nprocesses = ["capture"]\nlisten = ["tls/127.0.0.1:{port}"]\n'
            '[host.brain]\nrole = "brain"\nprocesses = ["executive"]\n[person.ada]\nrole = "operator"\n'
        )
        now = datetime.now(UTC)
        authority.init(self.site, now)
        authority.issue(self.site, "robot", "body", now, addresses=["127.0.0.1"])
        authority.issue(self.site, "brain", "brain", now)
        authority.issue(self.site, "operator", "ada", now)
        self._envs = {"body": dict(os.environ), "brain": os.environ | wall.env, "desk": dict(os.environ)}
        for name, env in self._envs.items():
            env["COCORO_RUN_DIR"] = str(root / name)
        self.running: list[Running] = []

    def start(self, host: str, *prefix: str) -> Running:
        command = [*prefix, *COCORO, "up", "--site", str(self.site), "--host", host]
        self.running.append(Running(command, self._envs[host]))
        return self.running[-1]

    def folder(self, host: str) -> Path:
        return self.root / host / ROBOT

    def offset_s(self, host: str) -> float:
        """From the host's steady clock to the robot's time there; read past the check of the time namespace."""
        (offset_ns,) = struct.unpack_from("=q", (self.folder(host) / robot_time.FILE).read_bytes())
        return float(offset_ns / NS)

    def status(self) -> dict[str, Any]:
        command = [*COCORO, "status", "--json", "--site", f"ada@{self.site}"]
        done = subprocess.run(command, env=self._envs["desk"], capture_output=True, text=True, timeout=PATIENCE_S)
        report: dict[str, Any] = json.loads(done.stdout)
        return report

    def until(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Asks for the status until it is as it should be."""
        end_s = time.monotonic() + PATIENCE_S
        while not holds(report := self.status()):
            assert time.monotonic() < end_s, report
        return report


@contextmanager
def hosts(root: Path, wall: WallClock) -> Iterator[Hosts]:
    made = Hosts(root, wall)
    try:
        yield made
    finally:
        for running in reversed(made.running):
            if running.process.poll() is None:
                running.end(signal.SIGINT)


def clock_of(report: dict[str, Any], host: str) -> dict[str, Any]:
    return next((one for one in report["clocks"] if one["host"] == host), {"state": ""})


def service(report: dict[str, Any], name: str) -> dict[str, Any]:
    return next((one for one in report["services"] if one["service"] == name), {"state": "", "alive": False})


def test_two_hosts_with_different_clocks_have_one_time_and_a_wrong_one_is_kept_out(wall: WallClock) -> None:
    with in_short_folder() as root, hosts(root, wall) as site:
        site.start("body").until("is up")
        site.start("brain", *UNSHARE).until("is up")

        apart_s = site.offset_s("brain") + STARTED_S - site.offset_s("body")
        assert abs(apart_s) < 0.3, f"set before the start; its wall clock was {WRONG_S} s wrong"
        report = site.until(lambda now: clock_of(now, "brain")["state"] == "follows")
        now = clock_of(report, "brain")
        assert (now["keeper"], clock_of(report, "body")["state"]) == ("body", "keeps")
        assert abs(now["ahead_s"]) < 0.3
        assert service(report, "executive")["alive"]

        # The keeper's clock is set: from then on `brain` is wrong, and nothing of it passes.
        setting = robot_time.setting(site.folder("body"))
        right_ns = setting.offset_ns
        setting.correct(right_ns + NS)
        report = site.until(lambda now: clock_of(now, "brain")["state"] == "refused")
        report = site.until(lambda now: not service(now, "executive")["alive"])
        gateway = service(report, "gateway-brain")
        assert gateway["state"] == "degraded"
        assert gateway["health"]["text"].startswith("its clock is ")
        assert "what brain says is not passed on" in gateway["health"]["text"]

        # Set right again, it is admitted after a while.
        setting.correct(right_ns)
        site.until(lambda now: service(now, "executive")["alive"] and clock_of(now, "brain")["state"] == "follows")
