"""Every command of `cocoro`, the surroundings in which each is run, and the conditions that it must meet there."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cli_forks import Case, Ending

from apps.cli import exits
from apps.cli.app import load
from apps.cli.listed import COMMANDS as LISTED
from apps.cli.task_commands import task_command, task_names

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
CODES = (exits.DONE, exits.FAILED, exits.USAGE, exits.REFUSED, exits.NO_MESH)

ARGUMENTS: dict[str, str] = {
    "fetch": "{name}",
    "follow": "{name}",
    "touch": "{name}",
    "go-to": "{name}",
    "go-there": "--x 1 --y 0",
    "policy": "{name}",
    "rehearse fetch": "{name} --seed -1",
    "snapshot": "{name}.png",
    "record": "--out {name}",
    "replay": "{capture} --paused",
    "export": "{capture} --foxglove {name}.mcap",
    "view": "{capture}",
    "echo": "{name}",
    "hz": "{name}",
    "experiment": "E9",
    "up": "{name}.toml",
    "run": "{name}",
    "estop": "--robot {name}",  # otherwise it would stop every robot on this machine
    "stop": "--robot {name}",
    "objects learn": "mug --from {name}.png",
    "capture info": "{capture}",
    "capture repair": "{capture} --out {name}.mcap",
    "capture pin": "{name}",
    "capture unpin": "{name}",
    "capture remove": "{name} --yes",
    "capture reexecute": "{capture} --service {name}",
    "capture rerun": "{capture} --service {name}",
    "capture latency": "{capture}",
    "new service": "nearest --into {name}",
    "new task": "greet --into {name}",
    "new robot": "ada --urdf {urdf} --into {name}",
    "pki init": "--site {name}",
    "pki issue": "robot base --site {name}",
    "pki renew": "base --site {name}",
    "pki revoke": "base --site {name}",
    "pki list": "--site {name}",
    "cockpit invite": "viewer",
    "cockpit end": "{name}",
    "servos set-id": "1 2 --port {name}",
    "servos set-wheel": "1 --port {name}",
    "servos calibrate": "elbow",
    "servos import": "{name}",
    "servos limits": "elbow",
    "kinect tilt": "5",
    "learn arm": "{name}.jsonl",
    "learn wheels": "{name}.jsonl",
}
"""For each command arguments with which it ends soon and, if it can without a robot, successfully. It must not open a
zenoh session, since it runs in a forked child."""


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """All commands by name, without groups."""
    if not hasattr(command, "commands"):
        yield " ".join(path), command
        return
    if path and command.invoke_without_command:
        yield " ".join(path), command
    for name, sub in command.commands.items():
        yield from commands(sub, (*path, name))


LOADED: dict[str, Any] = {
    **{row.name: load(row.name) for row in LISTED if row.name != "rehearse"},
    **{name: task_command(name) for name in task_names()},
    "rehearse fetch": task_command("fetch"),  # the other rehearsals are made in the same way
}
COMMANDS = dict(found for name, command in LOADED.items() for found in commands(command, tuple(name.split())))


@dataclass(frozen=True)
class Surroundings:
    """Faults of a command's environment."""

    what: dict[str, Any] = field(default_factory=dict)
    """Fields of a Case; {root} in `env` and `mounts` is the test's folder."""
    odd: str = ""
    """Part of the names of all folders and files."""
    lost: bool = False
    """Whether standard output is lost."""
    same: bool = True
    """Whether the exit code is that of good surroundings."""
    lines: int = 1
    """Greatest number of error messages."""
    helps: bool = False
    """Whether `--help` is run, too."""


NOT_UTF8 = "caf\udce9"

SURROUNDINGS: dict[str, Surroundings] = {
    "stdout closed": Surroundings({"stdout": "closed"}, lost=True, helps=True),
    "all closed": Surroundings({"stdin": "closed", "stdout": "closed", "stderr": "closed"}, lost=True),
    "stdin and stderr closed, home and run directory read-only": Surroundings(
        {
            "stdin": "closed",
            "stderr": "closed",
            "env": {"HOME": "{root}/disk", "COCORO_RUN_DIR": "{root}/disk/run"},
            "mounts": [("{root}/disk", "ro")],
        }
    ),
    "stdout on a full device": Surroundings({"stdout": "full"}, lost=True),
    "both unbuffered on a full device, no home, a width that is none": Surroundings(
        {
            "stdout": "full",
            "stderr": "full",
            "unbuffered": True,
            "env": {"HOME": None, "XDG_RUNTIME_DIR": None, "COCORO_RUN_DIR": None, "COLUMNS": "wide", "LINES": "-1"},
        },
        lost=True,
    ),
    "a pipe that nobody reads": Surroundings({"stdout": "gone"}, lost=True),
    "ASCII alone, a run directory that is a broken link": Surroundings(
        {"encoding": "ascii", "env": {"COCORO_RUN_DIR": "{root}/broken"}}, odd="für"
    ),
    "names that are no UTF-8": Surroundings(
        {"env": {"COCORO_RUN_DIR": f"{{root}}/{NOT_UTF8}"}}, odd=NOT_UTF8, same=False
    ),
    "names of several lines, a run directory too long for a socket": Surroundings(
        {"env": {"COCORO_RUN_DIR": "{root}/" + "x" * 120}}, odd="a\nb\x1b[2Jc"
    ),
    "a current directory that was removed": Surroundings({"no_folder": True}, same=False),
    "no terminal to speak of, a run directory that is a file": Surroundings(
        {"env": {"TERM": None, "COLUMNS": "1", "LINES": "1", "COCORO_RUN_DIR": str(GOLDEN)}, "stdout": "narrow"},
        same=False,
    ),
    "a dumb terminal": Surroundings(
        {"env": {"TERM": "dumb", "COLUMNS": None}, "stdout": "narrow", "stderr": "narrow"}, helps=True
    ),
    "a run directory too long for a file": Surroundings({"env": {"COCORO_RUN_DIR": "{root}/" + "x" * 300}}, same=False),
    "no /proc": Surroundings({"mounts": [("/proc", "size=64k")]}, lines=2),
}
"""Each row combines faults that do not depend on one another."""

NEVER_SAID = (
    "Traceback", "Exception ignored", "internal error", "excepthook", "WARN", "Fatal", "Error in", "Aborted",
)  # fmt: skip


class Table:
    """Runs commands in surroundings."""

    def __init__(self, forks: Callable[[Case], Ending], root: Path) -> None:
        self._forks = forks
        self._root = root
        self._usual: dict[tuple[str, bool], Ending] = {}
        self._calls: dict[tuple[str, bool], int] = {}

    def play(self, command: str, surroundings: Surroundings, help_: bool = False, arguments: str = "") -> Ending:
        folder = Path(tempfile.mkdtemp(prefix=surroundings.odd, dir=self._root))
        name = f"{surroundings.odd}x"
        (folder / f"{name}_capture.mcap").symlink_to(self._root / "capture.mcap")
        (folder / f"{name}_picture.png").symlink_to(self._root / "picture.png")
        (folder / f"{name}_arm.urdf").symlink_to(self._root / "desk.urdf")
        words = {
            "name": name,
            "capture": str(folder / f"{name}_capture.mcap"),
            "golden": str(GOLDEN),
            "picture": str(folder / f"{name}_picture.png"),
            "urdf": str(folder / f"{name}_arm.urdf"),
        }
        what = dict(surroundings.what)
        run = Path(tempfile.mkdtemp(dir=self._root))
        env = {"COCORO_RUN_DIR": str(run), "TMPDIR": str(run), "NO_COLOR": None} | what.pop("env", {})
        env = {key: value and value.format(root=self._root) for key, value in env.items()}
        mounts = [(place.format(root=self._root), options) for place, options in what.pop("mounts", ())]
        given = (
            ["--help"]
            if help_
            else [word.format(**words) for word in (arguments or ARGUMENTS.get(command, "")).split()]
        )
        place = folder
        if what.get("no_folder"):
            place = Path(tempfile.mkdtemp(dir=self._root))
        try:
            return self._forks(Case([*command.split(), *given], str(place), env=env, mounts=mounts, **what))
        finally:
            shutil.rmtree(folder)
            shutil.rmtree(run)

    def calls(self, command: str, fresh: bool) -> int:
        """Number of Python function calls of a command."""
        if (command, fresh) not in self._calls:
            self._calls[command, fresh] = self.play(command, Surroundings({"at_call": -1, "fresh": fresh})).calls
        return self._calls[command, fresh]

    def usual(self, command: str, help_: bool = False) -> Ending:
        """The end of a command in good surroundings."""
        if (command, help_) not in self._usual:
            self._usual[command, help_] = self.play(command, Surroundings(), help_)
        return self._usual[command, help_]


def wrong(ending: Ending, usual: Ending, surroundings: Surroundings) -> list[str]:
    """The requirements that the ending of a command misses."""
    found = []
    said = ending.out + ending.err
    lines = [line for line in ending.err.splitlines() if line.startswith("cocoro: ")]
    lost = surroundings.lost and bool(usual.out)
    kept = surroundings.what.get("stderr", "kept") == "kept"
    code = (usual.code or exits.FAILED) if lost else usual.code
    if ending.hung:
        found.append("hangs")
    if ending.code not in CODES or (surroundings.same and ending.code != code):
        found.append(f"exit code {ending.code}, usually {usual.code}")
    if words := [word for word in NEVER_SAID if word in said]:
        found.append(f"says {words[0]}")
    if lost and kept and not any("standard output" in line for line in lines):
        found.append("does not say that its output is lost")
    if len(set(lines)) > surroundings.lines + lost:  # SIGINT during a write may print a line twice
        found.append("says several things")
    if kept and ending.code and not ending.err.strip() and not ending.out.strip():
        found.append("fails in silence")
    return found
