"""The processes of `bench.scale`: a hub's real gateway, the workers that speak for the robots' hosts, the persons."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import psutil

from bench import scale_site
from bench.scale_site import HUB, OPERATOR, VIEWER
from cocoro.clock import steady_ns
from cocoro.errors import ConfigError
from cocoro.private import RUN_DIR
from deploy.rundir import RunDir
from deploy.site.component import gateway_of
from deploy.site.plan import Site

NS = 1_000_000_000
WORKERS = 2
WARM_S = 2
RESTART_S = 12
"""Longest time for the restart of the hub; the robots speak for as long."""
AHEAD_NS = NS // 2
"""Time from the order to speak until the first message."""
DRAIN_S = 1.0
STOPS, FLEET_STOPS = 20, 5
PATIENCE_S = 120.0
LINKED_S = 30.0


class Worker:
    """A process of `bench.scale_worker`."""

    def __init__(self, given: Mapping[str, Any], log: Path) -> None:
        with log.open("ab") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "bench.scale_worker", json.dumps(given)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True, start_new_session=True,
            )  # fmt: skip

    def answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise ConfigError("a worker of the bench has ended")
        found: dict[str, Any] = json.loads(line)
        return found

    def order(self, do: str, **more: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, **more}) + "\n")
        self.process.stdin.flush()

    def ask(self, do: str, **more: Any) -> dict[str, Any]:
        self.order(do, **more)
        return self.answer()

    def end(self) -> None:
        with contextlib.suppress(OSError):
            self.order("end")
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Fleet:
    """A hub, its robots and persons, up. Make it with `fleet`."""

    def __init__(self, folder: Path, site: Site, robots: int, *, direct: bool) -> None:
        self.site = site
        self.robots = [scale_site.robot(number) for number in range(1, robots + 1)]
        self.direct = direct
        self._folder = folder
        self._port = int(site.hosts[HUB].listen[0].rpartition(":")[2])
        self.shares = {name: scale_site.share_of(site, name) for name in site.hosts if name != HUB}
        self.gateway: psutil.Process | None = None
        self.hub: psutil.Process | None = None
        self.workers: list[Worker] = []
        self.persons: dict[str, Worker] = {}

    def start(self) -> float:
        """Starts the hub, then everybody. Returns the seconds until the hub listened."""
        up_s = self.start_hub()
        real = [] if self.direct else [scale_site.body(1)]
        if real:
            self.gateway = self._gateway(real[0], self._folder / "run" / real[0])
        for part in range(min(WORKERS, len(self.robots))):
            mine = range(part + 1, len(self.robots) + 1, WORKERS)
            hosts = [name for number in mine for name in (scale_site.body(number), scale_site.brain(number))]
            phase = {
                host: (number - 1) / len(self.robots) + shift / (2 * len(self.robots))
                for number in mine
                for shift, host in enumerate((scale_site.body(number), scale_site.brain(number)))
            }
            given = {"as": "hosts", "hosts": hosts, "phase": phase, "direct": self.direct, "real": real}
            self.workers.append(self._worker(given))
        for name in (OPERATOR, VIEWER):
            self.persons[name] = self._worker({"as": "person", "person": name})
        for worker in (*self.workers, *self.persons.values()):
            worker.answer()
        return up_s

    def start_hub(self) -> float:
        begun_s = time.monotonic()
        self.hub = self._gateway(HUB, self._folder / "hub")
        while not self._listens():
            if time.monotonic() - begun_s > PATIENCE_S or not self.hub.is_running():
                raise ConfigError(f"the hub does not come up: {self.log(HUB)[-500:]}")
            time.sleep(0.01)
        return time.monotonic() - begun_s

    def stop_hub(self) -> None:
        assert self.hub is not None
        self.hub.terminate()
        self.hub.wait(PATIENCE_S)

    def log(self, host: str) -> str:
        return (self._folder / f"{host}.log").read_text(errors="replace")

    def _listens(self) -> bool:
        assert self.hub is not None
        wanted = f":{self._port:04X} 00000000:0000 0A"
        return wanted in Path("/proc/net/tcp").read_text()

    def _worker(self, given: dict[str, Any]) -> Worker:
        where = {"site": str(self.site.folder), "run": str(self._folder / "run")}
        return Worker({**where, **given}, self._folder / "workers.log")

    def _gateway(self, host: str, root: Path) -> psutil.Process:
        """Starts the gateway's process of a host alone."""
        name = gateway_of(host).name
        share = self.site.share_profile(host)
        run_dir = RunDir(share.robot, root)
        run_dir.make()
        run_dir.remember(msgspec.json.encode(msgspec.structs.replace(share, processes=(name,))))
        with (self._folder / f"{host}.log").open("ab") as log:
            started = subprocess.Popen(
                [sys.executable, "-m", "deploy.launch", name, "--run-dir", str(run_dir.path)],
                stderr=log,
                env={**os.environ, RUN_DIR: str(root)},
                start_new_session=True,
            )
        return psutil.Process(started.pid)

    def end(self) -> None:
        for worker in (*self.workers, *self.persons.values()):
            worker.end()
        for process in (self.hub, self.gateway):
            if process is not None and process.is_running():
                process.terminate()
                with contextlib.suppress(psutil.TimeoutExpired):
                    process.wait(5.0)
                if process.is_running():
                    process.kill()

    # --- what is measured -------------------------------------------------------------------------

    def speak(self, seconds: int) -> int:
        """Lets all hosts speak from the same time on, which it returns."""
        begin_ns = steady_ns() + AHEAD_NS
        for worker in self.workers:
            worker.order("speak", begin_ns=begin_ns, seconds=seconds)
        return begin_ns

    def spoken(self) -> list[dict[str, Any]]:
        return [worker.answer() for worker in self.workers]

    def link(self) -> None:
        """Speaks until the operator has heard every robot. Raises ConfigError when he does not."""
        operator = self.persons[OPERATOR]
        deadline_s = time.monotonic() + LINKED_S
        while True:
            operator.ask("forget")
            self.speak(WARM_S)
            self.spoken()
            missing = {*self.robots} - {*operator.ask("first")["first"]}
            if not missing:
                return
            if time.monotonic() > deadline_s:
                raise ConfigError(f"{len(missing)} robots of {len(self.robots)} are not heard at the hub")

    def measure(self, seconds: int) -> dict[str, Any]:
        """One measurement under load."""
        assert self.hub is not None
        time.sleep(DRAIN_S)
        for worker in (*self.workers, *self.persons.values()):
            worker.ask("heard")
        begin_ns = self.speak(seconds)
        time.sleep(max(0.0, (begin_ns - steady_ns()) / NS))
        psutil.cpu_percent()
        before = [cpu_s(process) for process in (self.hub, self.gateway)]
        begun_s = time.monotonic()
        operator = self.persons[OPERATOR]
        stops = [operator.ask("stop", robots=[self.robots[turn % len(self.robots)]]) for turn in range(STOPS)]
        fleet = [operator.ask("stop", robots=self.robots) for _ in range(FLEET_STOPS)]
        time.sleep(max(0.0, begin_ns / NS + seconds - 0.2 - steady_ns() / NS))
        took_s = time.monotonic() - begun_s
        after = [cpu_s(process) for process in (self.hub, self.gateway)]
        busy = psutil.cpu_percent() / 100.0
        memory = [memory_mb(process) for process in (self.hub, self.gateway)]
        spoken = self.spoken()
        time.sleep(DRAIN_S)
        used = [(end - start) / took_s for start, end in zip(before, after, strict=True)]
        return {
            "spoken": spoken, "stops": stops, "fleet": fleet, "used": used, "memory": memory, "busy": busy,
            "hosts": [worker.ask("heard") for worker in self.workers],
            "persons": {name: worker.ask("heard")["heard"] for name, worker in self.persons.items()},
            "seconds": seconds,
        }  # fmt: skip

    def restart(self) -> float | None:
        """Ends the hub's process and starts it anew while all speak; the seconds until all robots are heard again, None
        when not all are."""
        operator = self.persons[OPERATOR]
        begin_ns = self.speak(RESTART_S)
        time.sleep(max(0.0, (begin_ns - steady_ns()) / NS) + 1.0)
        self.stop_hub()
        ended_ns = steady_ns()
        operator.ask("forget")
        self.start_hub()
        first: dict[str, int] = {}
        while len(first) < len(self.robots) and steady_ns() < begin_ns + (RESTART_S - 1) * NS:
            time.sleep(0.05)
            first = operator.ask("first")["first"]
        self.spoken()
        return (max(first.values()) - ended_ns) / NS if len(first) == len(self.robots) else None


def cpu_s(process: psutil.Process | None) -> float:
    if process is None:
        return 0.0
    times = process.cpu_times()
    return float(times.user + times.system)


def memory_mb(process: psutil.Process | None) -> float:
    return 0.0 if process is None else float(process.memory_full_info().uss) / 1e6


@contextlib.contextmanager
def fleet(folder: Path, site: Site, robots: int, *, direct: bool) -> Iterator[tuple[Fleet, float]]:
    made = Fleet(folder, site, robots, direct=direct)
    try:
        yield made, made.start()
    finally:
        made.end()
