"""Every command, in every surroundings: however its streams, names, folders, terminal and signals are, it ends in an
exit code that is documented, and in words. Nothing here is about what a command does when all is well.

The commands are those of the Typer app, so a new one is tested by itself; what it must be given stands in ARGUMENTS of
`cli_surroundings`.
"""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cli_forks import FULL, NO_MOUNTS, TALKED, Forks
from cli_surroundings import ARGUMENTS, COMMANDS, GOLDEN, NOT_UTF8, SURROUNDINGS, Surroundings, Table, wrong
from places import in_short_folder
from urdf_rig import desk_arm

from apps.captures.rewrite import rewrite
from apps.cli import exits
from apps.cli.main import failed
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from services.capture.packing import Packer


@pytest.fixture(scope="module")
def root() -> Iterator[Path]:
    with in_short_folder() as path:
        (path / "disk").mkdir()
        (path / "broken").symlink_to("nowhere")
        picture = np.full((60, 80, 3), 200, np.uint8)
        cv2.rectangle(picture, (30, 20), (50, 40), (20, 120, 240), cv2.FILLED)
        assert cv2.imwrite(str(path / "picture.png"), picture)
        desk_arm(path)
        with Capture.open(GOLDEN) as capture:
            rewrite(capture, path / "capture.mcap", Packer("zstd"), end_ns=capture.start_ns + NS // 5)
        yield path


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks() as forks:
        yield forks


@pytest.fixture(scope="module")
def table(forks: Forks, root: Path) -> Table:
    return Table(forks, root)


# --- the table ------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_arguments_to_be_tried_with(command: str) -> None:
    required = [parameter.name for parameter in COMMANDS[command].params if parameter.required]
    assert not required or command in ARGUMENTS, f"it must be given {required}: put some into ARGUMENTS"


def test_no_arguments_are_kept_for_commands_that_are_gone() -> None:
    assert set(ARGUMENTS) <= set(COMMANDS)


@pytest.mark.process
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


@pytest.mark.process
def test_so_it_does_in_the_locale_of_c(table: Table, root: Path) -> None:
    """In this locale Python takes every file name for ASCII, and prints nothing else."""
    surroundings = Surroundings({"encoding": "ascii"}, odd="für")
    with Forks(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0") as forks:
        in_c = Table(forks, root)
        endings = {command: in_c.play(command, surroundings) for command in COMMANDS}
    failures = [f"cocoro {c}: {wrong(e, table.usual(c), surroundings)}:\n{e.err}" for c, e in endings.items()]
    assert not [line for line in failures if ": []:" not in line]
    assert "für" in endings["export"].out  # as the bytes that the name has


@pytest.mark.process
def test_all_is_well_where_nothing_is_wrong(table: Table) -> None:
    """The table is not one of commands that all fail alike."""
    well = {command for command in COMMANDS if table.usual(command).code == exits.DONE}
    writers = {"export", "capture info", "capture repair", "new service", "new robot", "topics", "down"}
    assert well >= writers, [table.usual(command) for command in writers - well]
    assert all(not table.usual(command).err or table.usual(command).code for command in writers)


# --- signals --------------------------------------------------------------------------------------

SPREAD = (0.05, 0.3, 0.6, 0.95)
"""Where in a command a signal comes, as a share of its calls of Python functions."""
FIRST = 25
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


@pytest.mark.process
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


@pytest.mark.process
@pytest.mark.parametrize("command", ["topics", "stop", "status"])
def test_a_signal_while_it_imports_ends_it_in_silence(command: str, table: Table) -> None:
    failures = [
        line
        for step in range(5)
        for line in interrupted(table, command, (step + 0.5) / 5, fresh=True, again=bool(step % 2))
    ]
    assert not failures, "\n".join(failures)


@pytest.mark.process
def test_being_told_to_end_does_so_where_ctrl_c_is_ignored(table: Table) -> None:
    """Ctrl-C is ignored in the background of a script."""
    ending = table.play("topics", Surroundings({"at_call": 100, "number": signal.SIGTERM, "deaf": True}))
    assert (ending.code, ending.err) == (exits.REFUSED, "")


# --- what is nobody's mistake ---------------------------------------------------------------------


@pytest.mark.process
def test_a_bug_is_one_line_and_its_traceback_can_be_had(table: Table) -> None:
    bug = {"instead": ("apps.cli.topics:table", "bug")}
    ending = table.play("topics", Surroundings(bug))
    assert ending.code == exits.FAILED
    assert ending.err == (
        "cocoro: internal error, please report it: ZeroDivisionError: a bug\\nof two lines (in apps.cli.topics, line "
        f"{line_of('else table()')}); COCORO_LOG=debug shows the traceback\n"
    )
    told = table.play("topics", Surroundings(bug | {"env": {"COCORO_LOG": "debug"}}))
    assert told.code == exits.FAILED
    assert "Traceback (most recent call last)" in told.err
    assert told.err.endswith(ending.err)


@pytest.mark.process
def test_what_is_logged_is_a_line_each(table: Table) -> None:
    logs = {"instead": ("apps.cli.topics:table", "log")}
    ending = table.play("topics", Surroundings(logs))
    assert (ending.code, ending.err) == (exits.DONE, "cocoro: a callback failed: ValueError: of two\\nlines\n")
    assert (
        "ValueError: of two\nlines" in table.play("topics", Surroundings(logs | {"env": {"COCORO_LOG": "debug"}})).err
    )


def test_the_error_of_one_task_of_several_is_told_as_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    error = OSError(errno.EACCES, os.strerror(errno.EACCES), "a file")
    assert failed(ExceptionGroup("tasks", [ExceptionGroup("more", [error])])) == exits.FAILED
    assert re.fullmatch(r"cocoro: a file: Permission denied.*\n", capsys.readouterr().err)


def line_of(text: str) -> int:
    lines = (Path(__file__).parent.parent / "apps" / "cli" / "topics.py").read_text(encoding="utf-8").splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


@pytest.mark.process
def test_an_emergency_stop_goes_on_though_nobody_hears_of_it(table: Table) -> None:
    talking = {"instead": ("apps.cli.estop:main", "talk")}
    for place in ("closed", "full", "gone"):
        ending = table.play("stop", Surroundings({"stdout": place, "stderr": place} | talking))
        assert ending.code == TALKED  # the first word that was lost has not ended it
    ending = table.play("topics", Surroundings({"stdout": "full", "instead": ("apps.cli.topics:table", "talk")}))
    assert ending.code == exits.FAILED  # as it ends any other command


# --- what is written ------------------------------------------------------------------------------

WRITERS = {
    "export": ("{golden} --video {name}.mp4", "{capture} --foxglove {name}.mcap", "{capture} --csv {name}"),
    "capture repair": ("{capture} --out {name}.mcap",),
    "new service": ("nearest --into {name}",),
    "new robot": ("ada --urdf {urdf} --into {name}",),
    "pki init": ("--site {name}",),
    "objects learn": ("mug --from {picture} --size 0.08x0.1 --catalogue {name}.toml --picture {name}.png --yes",),
}
"""Commands that write files without a robot."""


@pytest.mark.process
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


@pytest.mark.process
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

COMMAND = f"{sys.executable} -m apps.cli.main"


@pytest.mark.process
@pytest.mark.parametrize(
    ("shell", "code", "said"),
    [
        (f"{COMMAND} topics >&-", exits.FAILED, "standard output: it is closed"),
        (f"{COMMAND} topics >&- 2>&- <&-", exits.FAILED, ""),
        (f"LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {COMMAND} export gröden.mcap --csv x", exits.FAILED, "gröden"),
        (f"{COMMAND} topics | true; exit ${{PIPESTATUS[0]}}", None, ""),
        (
            f"mkdir gone && cd gone && rmdir ../gone && {COMMAND} record",
            exits.FAILED,
            "current directory has been removed",
        ),
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
