"""Runs `cocoro` as a separate process, with small components to start."""

from __future__ import annotations

import os
import queue
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType

from places import short_folder

from deploy.rundir import RunDir, Target

PATIENCE_S = 300.0
"""Time limit for every wait, s; a test that reaches it has failed."""

PARTS = """
import asyncio, os, signal
from pathlib import Path
import msgspec
from cocoro.component import Component

good = Component(name="good", module="parts.good", services=("good",), doc="Does nothing, well.", backoff_s=0.01)
pair = Component(name="pair", module="parts.good", services=("left", "right"), doc="Two services in one process.")
dies = Component(name="dies", module="parts.dies", services=("dies",), doc="Crashes at its start.")
mute = Component(name="mute", module="parts.mute", services=("mute",), doc="Never gets ready.", start_s=0.5)
slow = Component(name="slow", module="parts.mute", services=("slow",), doc="Takes for ever to get ready.")
deaf = Component(name="deaf", module="parts.deaf", services=("deaf",), doc="Does not end when told.", stop_s=0.3)
planning = Component(name="planning", module="parts.good", doc="Takes a taken name.")
loops = Component(name="loops", module="parts.loops", doc="Loops for ever at SIGUSR1.", backoff_s=0.01)
once = Component(name="once", module="parts.good", services=("once",), doc="Is not restarted.", restart="never")
"""
GOOD = """
import asyncio, msgspec
from cocoro.component import Implementation
class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pace_hz: float = 1.0
async def run(node, config):
    siblings = [node.sibling(name) for name in ("left", "right")] if node.name == "pair" else []
    for part in (node, *siblings):
        part.ready()
    await asyncio.Event().wait()
implementation = Implementation(Config, run)
"""
DIES = """
import msgspec
from cocoro.component import Implementation
class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
async def run(node, config):
    raise RuntimeError("the motor is on fire")
implementation = Implementation(Config, run)
"""
MUTE = """
import asyncio, msgspec
from cocoro.component import Implementation
class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
async def run(node, config):
    await asyncio.Event().wait()
implementation = Implementation(Config, run)
"""
DEAF = """
import asyncio, msgspec
from cocoro.component import Implementation
class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
async def run(node, config):
    node.ready()
    while True:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            pass
implementation = Implementation(Config, run)
"""
LOOPS = """
import asyncio, signal, msgspec
from cocoro.component import Implementation
class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
def for_ever():
    while True:
        pass
async def run(node, config):
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, for_ever)
    node.ready()
    await asyncio.Event().wait()
implementation = Implementation(Config, run)
"""


def install_parts(folder: Path) -> None:
    """Make the parts a distribution below `folder`, with its entry points, as a third party's would be."""
    package = folder / "parts"
    package.mkdir()
    (package / "__init__.py").write_text(PARTS)
    for name, text in {"good": GOOD, "dies": DIES, "mute": MUTE, "deaf": DEAF, "loops": LOOPS}.items():
        (package / f"{name}.py").write_text(text)
    about = folder / "parts-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: parts\nVersion: 1.0\n")
    rows = "".join(
        f"{name} = parts:{name}\n" for name in ("good", "pair", "dies", "mute", "slow", "deaf", "once", "loops")
    )
    (about / "entry_points.txt").write_text(f"[cocoro.components]\n{rows}")


class Shell:
    """A context manager with a new run directory for its commands. At the end it shuts a running robot down."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.root = short_folder()
        self.run_dir = RunDir("robbie", self.root)
        self.prefix: list[str] = []
        """Put in front of every command, for example to run it in a namespace."""
        self._started: list[Running] = []
        install_parts(folder)

    def __enter__(self) -> Shell:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.run_dir.supervisor() or self.run_dir.claims():
            self("down")
        for running in self._started:
            running.process.kill()
            running.process.wait()
        shutil.rmtree(self.root)

    @property
    def env(self) -> dict[str, str]:
        path = os.pathsep.join(filter(None, (str(self.folder), os.environ.get("PYTHONPATH"))))
        return os.environ | {"COCORO_RUN_DIR": str(self.root), "PYTHONPATH": path}

    def profile(self, *processes: str, extra: str = "") -> str:
        path = self.folder / "robbie.toml"
        path.write_text(f'robot = "robbie"\nprocesses = {list(processes)}\n{extra}')
        return str(path)

    def __call__(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [*self.prefix, sys.executable, "-m", "apps.cli.main", *arguments]
        return subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=PATIENCE_S, check=False)

    def start(self, *arguments: str) -> Running:
        self._started.append(Running([*self.prefix, sys.executable, "-m", "apps.cli.main", *arguments], self.env))
        return self._started[-1]

    def pid(self, service: str) -> int:
        return self.run_dir.claims()[service].pid

    def target(self, service: str) -> Target:
        """Process id of the current process of a service."""
        return Target(self.run_dir.path / "claims" / service)


class Running:
    """A running command, read line by line."""

    def __init__(self, command: list[str], env: dict[str, str]) -> None:
        self.process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.lines: list[str] = []
        self._queue: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as out:
            for line in out:
                self._queue.put(line.rstrip("\n"))
        self._queue.put(None)

    def until(self, text: str) -> str:
        """Read until a line contains `text`; returns the line."""
        while (line := self._queue.get(timeout=PATIENCE_S)) is not None:
            self.lines.append(line)
            if text in line:
                return line
        raise AssertionError(f"no {text!r} in:\n" + "\n".join(self.lines))

    def end(self, signal_number: int | None = None) -> int:
        """Send a signal (if given), read the rest of the output and return the exit code."""
        if signal_number is not None:
            self.process.send_signal(signal_number)
        while (line := self._queue.get(timeout=PATIENCE_S)) is not None:
            self.lines.append(line)
        return self.process.wait(PATIENCE_S)
