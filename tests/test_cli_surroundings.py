"""Every command, in every surroundings: however its streams, names, folders, terminal and signals are, it ends in an
exit code that is documented, and in words. Nothing here is about what a command does when all is well.

The commands are those of the Typer app, so a new one is tested by itself; what it must be given stands in ARGUMENTS.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer.main
from cli_forks import FULL, NO_MOUNTS, TALKED, Case, Ending, Forks

from cocoro.capture.compression import Packer
from cocoro.capture.reader import Capture
from cocoro.capture.rewrite import rewrite
from cocoro.cli import exits
from cocoro.cli.app import app
from cocoro.clock import NS

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
CODES = (exits.DONE, exits.FAILED, exits.USAGE, exits.REFUSED, exits.NO_MESH)

ARGUMENTS: dict[str, str] = {
    "fetch": "{name}",
    "follow": "{name}",
    "touch": "{name}",
    "go-to": "{name}",
    "rehearse": "dance",
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
    "objects learn": "mug --from {name}.png",
    "capture info": "{capture}",
    "capture repair": "{capture} --out {name}.mcap",
    "capture rerun": "{capture} --service {name}",
    "new service": "nearest --into {name}",
    "servos set-id": "1 2 --port {name}",
    "servos calibrate": "elbow",
    "servos limits": "elbow",
    "kinect tilt": "5",
    "learn arm": "{name}.jsonl",
    "learn wheels": "{name}.jsonl",
}
"""For each command arguments with which it ends soon and, where it can without a robot, well. No zenoh session may be
opened: the commands run in forked children."""


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Each that can be called, by its name."""
    if not hasattr(command, "commands"):
        yield " ".join(path), command
        return
    if path and command.invoke_without_command:
        yield " ".join(path), command
    for name, sub in command.commands.items():
        yield from commands(sub, (*path, name))


COMMANDS = dict(commands(typer.main.get_command(app)))


@dataclass(frozen=True)
class Surroundings:
    """What is wrong around a command."""

    what: dict[str, Any] = field(default_factory=dict)
    """Fields of a Case; in `env` and `mounts` {root} is a folder of the test's own."""
    odd: str = ""
    """Is in the names of all folders and files."""
    lost: bool = False
    """Standard output does not arrive."""
    same: bool = True
    """It ends with the exit code that it has when all is well."""
    helps: bool = False
    """`--help` is tried, too."""


NOT_UTF8 = "caf\udce9"

SURROUNDINGS: dict[str, Surroundings] = {
    "stdout closed": Surroundings({"stdout": "closed"}, lost=True, helps=True),
    "stdin and stderr closed": Surroundings({"stdin": "closed", "stderr": "closed"}),
    "all closed": Surroundings({"stdin": "closed", "stdout": "closed", "stderr": "closed"}, lost=True),
    "stdout on a full device": Surroundings({"stdout": "full"}, lost=True),
    "both unbuffered on a full device": Surroundings(
        {"stdout": "full", "stderr": "full", "unbuffered": True}, lost=True
    ),
    "a pipe that nobody reads": Surroundings({"stdout": "gone"}, lost=True),
    "ASCII alone": Surroundings({"encoding": "ascii"}, odd="für", helps=True),
    "names that are no UTF-8": Surroundings(
        {"env": {"COCORO_RUN_DIR": f"{{root}}/{NOT_UTF8}"}}, odd=NOT_UTF8, same=False
    ),
    "names of several lines": Surroundings(odd="a\nb\x1b[2Jc"),
    "a current directory that was removed": Surroundings({"no_folder": True}, same=False),
    "no home, and a width that is none": Surroundings(
        {"env": {"HOME": None, "XDG_RUNTIME_DIR": None, "COCORO_RUN_DIR": None, "COLUMNS": "wide", "LINES": "-1"}}
    ),
    "a home and a run directory that are read-only": Surroundings(
        {"env": {"HOME": "{root}/disk", "COCORO_RUN_DIR": "{root}/disk/run"}, "mounts": [("{root}/disk", "ro")]}
    ),
    "no terminal to speak of": Surroundings({"env": {"TERM": None, "COLUMNS": "1", "LINES": "1"}, "stdout": "narrow"}),
    "a dumb terminal": Surroundings(
        {"env": {"TERM": "dumb", "COLUMNS": None}, "stdout": "narrow", "stderr": "narrow"}, helps=True
    ),
    "a run directory that is a file": Surroundings({"env": {"COCORO_RUN_DIR": str(GOLDEN)}}),
    "a run directory that is a broken link": Surroundings({"env": {"COCORO_RUN_DIR": "{root}/broken"}}),
    "a run directory too long for a socket": Surroundings({"env": {"COCORO_RUN_DIR": "{root}/" + "x" * 120}}),
    "a run directory too long for a file": Surroundings({"env": {"COCORO_RUN_DIR": "{root}/" + "x" * 300}}, same=False),
    "no /proc": Surroundings({"mounts": [("/proc", "size=64k")]}),
}

NEVER_SAID = (
    "Traceback", "Exception ignored", "internal error", "excepthook", "WARN", "Fatal", "Error in", "Aborted",
)  # fmt: skip


@pytest.fixture(scope="module")
def root() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="cocoro") as folder:
        path = Path(folder)
        (path / "disk").mkdir()
        (path / "broken").symlink_to("nowhere")
        picture = np.full((60, 80, 3), 200, np.uint8)
        cv2.rectangle(picture, (30, 20), (50, 40), (20, 120, 240), cv2.FILLED)
        assert cv2.imwrite(str(path / "picture.png"), picture)
        with Capture.open(GOLDEN) as capture:
            rewrite(capture, path / "capture.mcap", Packer("zstd"), end_ns=capture.start_ns + NS // 5)
        yield path


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks() as forks:
        yield forks


class Table:
    """Plays commands in surroundings."""

    def __init__(self, forks: Forks, root: Path) -> None:
        self._forks = forks
        self._root = root
        self._usual: dict[tuple[str, bool], Ending] = {}
        self._calls: dict[tuple[str, bool], int] = {}

    def play(self, command: str, surroundings: Surroundings, help_: bool = False, arguments: str = "") -> Ending:
        folder = Path(tempfile.mkdtemp(prefix=surroundings.odd, dir=self._root))
        name = f"{surroundings.odd}x"
        (folder / f"{name}_capture.mcap").symlink_to(self._root / "capture.mcap")
        (folder / f"{name}_picture.png").symlink_to(self._root / "picture.png")
        words = {
            "name": name,
            "capture": str(folder / f"{name}_capture.mcap"),
            "golden": str(GOLDEN),
            "picture": str(folder / f"{name}_picture.png"),
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
        """How many functions of Python's it calls."""
        if (command, fresh) not in self._calls:
            self._calls[command, fresh] = self.play(command, Surroundings({"at_call": -1, "fresh": fresh})).calls
        return self._calls[command, fresh]

    def usual(self, command: str, help_: bool = False) -> Ending:
        """How it ends when all is well."""
        if (command, help_) not in self._usual:
            self._usual[command, help_] = self.play(command, Surroundings(), help_)
        return self._usual[command, help_]


@pytest.fixture(scope="module")
def table(forks: Forks, root: Path) -> Table:
    return Table(forks, root)


def wrong(ending: Ending, usual: Ending, surroundings: Surroundings) -> list[str]:
    """What is not as it must be."""
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
    if len(set(lines)) > 1 + lost:  # Ctrl-C while a line is written may write it twice
        found.append("says several things")
    if kept and ending.code and not ending.err.strip() and not ending.out.strip():
        found.append("fails in silence")
    return found


# --- the table ------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_arguments_to_be_tried_with(command: str) -> None:
    required = [parameter.name for parameter in COMMANDS[command].params if parameter.required]
    assert not required or command in ARGUMENTS, f"it must be given {required}: put some into ARGUMENTS"


def test_no_arguments_are_kept_for_commands_that_are_gone() -> None:
    assert set(ARGUMENTS) <= set(COMMANDS)


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_every_command_ends_in_words_and_with_its_exit_code(name: str, table: Table) -> None:
    surroundings = SURROUNDINGS[name]
    failures = []
    for command in COMMANDS:
        for help_ in (False, True) if surroundings.helps else (False,):
            ending, usual = table.play(command, surroundings, help_), table.usual(command, help_)
            if ending.code == NO_MOUNTS:
                pytest.skip("no mounts of one's own here (unshare(2) is not allowed)")
            if problems := wrong(ending, usual, surroundings):
                failures.append(f"cocoro {command}{' --help' if help_ else ''}: {', '.join(problems)}:\n{ending.err}")
    assert not failures, "\n".join(failures)


def test_so_it_does_in_the_locale_of_c(table: Table, root: Path) -> None:
    """Where Python takes every file name for ASCII, and prints nothing else."""
    surroundings = Surroundings({"encoding": "ascii"}, odd="für")
    with Forks(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0") as forks:
        in_c = Table(forks, root)
        endings = {command: in_c.play(command, surroundings) for command in COMMANDS}
    failures = [f"cocoro {c}: {wrong(e, table.usual(c), surroundings)}:\n{e.err}" for c, e in endings.items()]
    assert not [line for line in failures if ": []:" not in line]
    assert "für" in endings["export"].out  # as the bytes that the name has


def test_all_is_well_where_nothing_is_wrong(table: Table) -> None:
    """So that the table is not one of commands that all fail alike."""
    well = {command for command in COMMANDS if table.usual(command).code == exits.DONE}
    writers = {"export", "capture info", "capture repair", "new service", "topics", "down"}
    assert well >= writers, [table.usual(command) for command in writers - well]
    assert all(not table.usual(command).err or table.usual(command).code for command in writers)


# --- signals --------------------------------------------------------------------------------------

SPREAD = (0.05, 0.3, 0.6, 0.95)
"""Where in a command a signal comes, as a share of its calls of Python functions."""
FIRST = 4
"""Calls after which the command hears signals: until then Python itself does, as while it starts."""


def interrupted(table: Table, command: str, share: float, **what: Any) -> list[str]:
    """A signal comes somewhere in a command: what is not as it must be."""
    calls = table.calls(command, fresh=what.get("fresh", False))
    at = max(round(share * calls), FIRST)
    ending, usual = table.play(command, Surroundings({"at_call": at, **what})), table.usual(command)
    found = wrong(ending, usual, Surroundings(same=False, what={"stderr": "any"}))
    if ending.code not in (exits.REFUSED, usual.code) and command != "run":  # whose Ctrl-C is its good end
        found.append(f"exit code {ending.code}, not that of what was cancelled, nor {usual.code}")
    return [f"cocoro {command}, call {at} of {calls}: {problem}:\n{ending.err}" for problem in found]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_at_any_time_ends_a_command_as_cancelled(number: signal.Signals, table: Table) -> None:
    which = list(COMMANDS) if number == signal.SIGINT else list(COMMANDS)[:: len(SPREAD) - 1]
    shares = [SPREAD[place % len(SPREAD)] for place in range(len(which))]
    failures = [
        line
        for command, share in zip(which, shares, strict=True)
        for line in interrupted(table, command, share, number=number)
    ]
    assert not failures, "\n".join(failures)


@pytest.mark.parametrize("command", ["topics", "stop", "status", "capture info"])
def test_a_signal_while_it_imports_ends_it_in_silence(command: str, table: Table) -> None:
    failures = [
        line
        for step in range(6)
        for line in interrupted(table, command, (step + 0.5) / 6, fresh=True, again=bool(step % 2))
    ]
    assert not failures, "\n".join(failures)


def test_being_told_to_end_does_so_where_ctrl_c_is_ignored(table: Table) -> None:
    """As in the background of a script."""
    ending = table.play("topics", Surroundings({"at_call": 100, "number": signal.SIGTERM, "deaf": True}))
    assert (ending.code, ending.err) == (exits.REFUSED, "")


# --- what is nobody's mistake ---------------------------------------------------------------------


def test_a_bug_is_one_line_and_its_traceback_can_be_had(table: Table) -> None:
    bug = {"instead": ("cocoro.cli.topics:table", "bug")}
    ending = table.play("topics", Surroundings(bug))
    assert ending.code == exits.FAILED
    assert ending.err == (
        "cocoro: internal error, please report it: ZeroDivisionError: a bug\\nof two lines (in cocoro.cli.app, line "
        f"{line_of('listing.table()')}); COCORO_LOG=debug shows the traceback\n"
    )
    told = table.play("topics", Surroundings(bug | {"env": {"COCORO_LOG": "debug"}}))
    assert told.code == exits.FAILED
    assert "Traceback (most recent call last)" in told.err
    assert told.err.endswith(ending.err)


def line_of(text: str) -> int:
    lines = (Path(__file__).parent.parent / "cocoro" / "cli" / "app.py").read_text(encoding="utf-8").splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


def test_an_emergency_stop_goes_on_though_nobody_hears_of_it(table: Table) -> None:
    talking = {"instead": ("cocoro.cli.estop:main", "talk")}
    for place in ("closed", "full", "gone"):
        ending = table.play("stop", Surroundings({"stdout": place, "stderr": place} | talking))
        assert ending.code == TALKED  # the first word that was lost has not ended it
    ending = table.play("topics", Surroundings({"stdout": "full", "instead": ("cocoro.cli.topics:table", "talk")}))
    assert ending.code == exits.FAILED  # as it ends any other command


# --- what is written ------------------------------------------------------------------------------

WRITERS = {
    "export": ("{golden} --video {name}.mp4", "{capture} --foxglove {name}.mcap", "{capture} --csv {name}"),
    "capture repair": ("{capture} --out {name}.mcap",),
    "new service": ("nearest --into {name}",),
    "objects learn": ("mug --from {picture} --size 0.08x0.1 --catalogue {name}.toml --picture {name}.png --yes",),
}
"""Commands that write files without a robot."""


@pytest.mark.parametrize(("command", "arguments"), [(name, each) for name, row in WRITERS.items() for each in row])
def test_what_is_written_has_any_name_and_says_when_the_disk_is_full(
    command: str, arguments: str, table: Table, root: Path
) -> None:
    assert table.play(command, Surroundings(odd=NOT_UTF8), arguments=arguments).code == exits.DONE
    place = f"{root}/disk/"
    on_disk = arguments.replace("{name}", f"{place}{{name}}")
    full = Surroundings({"mounts": [(place, "size=8k")]})
    ending = table.play(command, full, arguments=on_disk)
    if ending.code == NO_MOUNTS:
        pytest.skip("no mounts of one's own here (unshare(2) is not allowed)")
    assert ending.code in (exits.FAILED, exits.USAGE)
    assert os.strerror(errno.ENOSPC) in ending.err
    assert place in ending.err
    assert len(ending.err.splitlines()) == 1, ending.err
    assert "pictures" not in ending.out


@pytest.mark.parametrize("command", ["run executive", "down", "up --detach", "status", "doctor sim"])
def test_a_run_directory_on_a_full_disk_is_named(command: str, table: Table, root: Path) -> None:
    disk = f"{root}/disk"
    full = Surroundings({"mounts": [(disk, FULL)], "env": {"COCORO_RUN_DIR": disk}})
    ending = table.play(command, full, arguments=" ")
    if ending.code == NO_MOUNTS:
        pytest.skip("no mounts of one's own here (unshare(2) is not allowed)")
    assert not wrong(ending, ending, full)
    assert (disk in ending.err + ending.out) == (
        command not in ("down", "status")
    )  # which look for robots, and find none


# --- the process itself ---------------------------------------------------------------------------

COMMAND = f"{sys.executable} -m cocoro.cli.main"


@pytest.mark.parametrize(
    ("shell", "code", "said"),
    [
        (f"{COMMAND} topics >&-", exits.FAILED, "standard output: it is closed"),
        (f"{COMMAND} topics >&- 2>&- <&-", exits.FAILED, ""),
        (f"LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {COMMAND} export gröden.mcap --csv x", exits.FAILED, "gröden"),
        (f"{COMMAND} topics | true; exit ${{PIPESTATUS[0]}}", None, ""),
        (f"mkdir gone && cd gone && rmdir ../gone && {COMMAND} record", exits.FAILED, "current directory is gone"),
    ],
)
def test_the_forks_are_as_the_process_is(
    shell: str, code: int | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COCORO_RUN_DIR", str(tmp_path / "run"))
    done = subprocess.run(["bash", "-c", shell], cwd=tmp_path, capture_output=True, check=False)
    err = done.stderr.decode(errors="surrogateescape")
    assert done.returncode == code if code is not None else done.returncode in (exits.DONE, exits.FAILED)
    assert said in err
    assert len(err.splitlines()) <= 1
