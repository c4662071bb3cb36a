"""Runs the README's commands, block by block, in order and as they are written: `python -m bench readme`.

    python -m bench readme                    # every block; some last for minutes
    python -m bench readme Operate Rehearse   # the blocks of the sections whose names begin so
    python -m bench readme --short            # what continuous integration runs (tests/test_readme.py)

Each block runs in a folder of its own, with a run directory, captures and latches of its own.
"""

from __future__ import annotations

import argparse
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from bench.report import Report
from bench.trials import Runs

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "README.md"
NOT_RUN = {
    "make demo": "installs the project; deploy/demo.sh does what the block of Operate does",
    "make test": "runs this",
    "cocoro up robot --detach": "needs the robot's hardware",
    "cocoro base": "needs the robot's hardware",
    "cocoro servos scan": "needs the robot's hardware",
    "cocoro kinect calibrate": "needs a Kinect",
    "cocoro view": "opens a window or a browser",
    "cocoro drive": "reads single keys from a terminal; tests/test_cli_drive.py has it",
    "cocoro site": "needs the folder of a site; tests/test_cli_site.py has it",
    "cocoro pki": "needs the folder of a site; tests/test_cli_pki.py has it",
    "cocoro up --site": "needs several machines; tests/test_site_hosts.py has it",
    "cocoro fetch red_can --site": "needs several machines; tests/test_site_hosts.py has it",
}
"""Commands that nobody can run everywhere, and why."""
SLOW = {
    "cocoro up sim --detach --sensors real --body worn --scene wheels": "the robot of the babbling",
    "cocoro babble arm --samples 1000": "moves for 3 minutes of real time",
    "cocoro babble wheels --trials 40": "moves for 2 minutes of real time",
    "cocoro learn arm --send": "needs the samples of the babbling",
    "cocoro learn wheels --send": "needs the trials of the babbling",
    "cocoro experiment E3 --seeds 3": "computes for 2 minutes",
    "cocoro up sim --scene unknown --objects objects.toml --detach": "tests/test_learn_object_cli.py has it",
    "cocoro fetch orange_can": "tests/test_learn_object_cli.py has it, in virtual time",
    "cocoro rehearse follow": "tests/test_rehearse.py has it",
    "cocoro rehearse fetch red_can --then": "tests/test_rehearse.py has it",
}
"""Commands that continuous integration has no time for, and why."""
ENDLESS = ("cocoro top", "cocoro echo", "cocoro hz", "cocoro logs -f", "cocoro view")
"""Commands that go on until Ctrl-C, which they get when they have printed something."""
LONG = ("cocoro replay",)
"""Commands that last as long as a capture; continuous integration cancels them after `LONG_S`."""
LONG_S = 5.0
CODES = {"cocoro doctor": 1}
"""Exit codes other than 0: the machine lacks the robot's hardware."""
PATIENCE_S = 600.0
SHOWN_S = 0.5
"""Time between the first output of an endless command and its Ctrl-C."""


@dataclass(frozen=True)
class Block:
    """A block of shell commands of a page."""

    section: str
    commands: tuple[str, ...]


@dataclass(frozen=True)
class Ran:
    """The end of a command."""

    command: str
    code: int
    seconds: float
    output: str

    cancelled: bool = False
    """Whether it got a Ctrl-C before its end."""

    @property
    def wrong(self) -> bool:
        code = 3 if self.cancelled else CODES.get(self.command, 0)
        return self.code != code or "internal error" in self.output or "Traceback" in self.output


def blocks(page: Path = PAGE) -> list[Block]:
    """The page's blocks of shell commands, without their comments."""
    found, section = [], ""
    for part in re.finditer(
        r"^## ([^\n]*)$|^```sh\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        if part[1] is not None:
            section = part[1]
            continue
        lines = (_without_comment(line) for line in part[2].replace("\\\n", " ").splitlines())
        found.append(Block(section, tuple(line for line in lines if line)))
    return found


def _without_comment(line: str) -> str:
    """The line up to a '#' that begins a word outside of quotes."""
    quote = ""
    for at, character in enumerate(line):
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character == "#" and (at == 0 or line[at - 1].isspace()):
            return line[:at].strip()
    return line.strip()


def begins(command: str, words: str) -> bool:
    return command == words or command.startswith(f"{words} ")


@dataclass
class Terminal:
    """A user's folder and environment, in which commands run one after the other."""

    folder: Path
    frames: str | None = None
    """Size and rate of all robots' frames."""
    quick: bool = False
    environment: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        (self.folder / "docs").symlink_to(ROOT / "docs")
        self.environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "COCORO_RUN_DIR": str(self.folder / "run"),
            "COCORO_CAPTURE_DIR": str(self.folder / "captures"),
            "COCORO_STATE_DIR": str(self.folder / "state"),
            **({"COCORO_FRAMES": self.frames} if self.frames else {}),
        }

    def run(self, command: str) -> Ran:
        begun_s = time.monotonic()
        process = subprocess.Popen(
            ["bash", "-c", f"exec {command}"], cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert process.stdout is not None
        output, cancelled = b"", False
        if self.quick and any(begins(command, words) for words in LONG):
            try:
                process.wait(LONG_S)
            except subprocess.TimeoutExpired:
                cancelled = True
                process.send_signal(signal.SIGINT)
        elif any(begins(command, words) for words in ENDLESS):
            if select.select([process.stdout], [], [], PATIENCE_S)[0]:
                output = os.read(process.stdout.fileno(), 65536)
            time.sleep(SHOWN_S)
            process.send_signal(signal.SIGINT)
        try:
            output += process.communicate(timeout=PATIENCE_S)[0]
        except subprocess.TimeoutExpired:
            process.kill()
            output += process.communicate()[0] + b"\nit did not end"
        return Ran(command, process.returncode, time.monotonic() - begun_s, output.decode(errors="replace"), cancelled)


def run_blocks(chosen: list[Block], terminal: Terminal) -> Iterator[Ran]:
    """Runs what can be run of the blocks, one command after the other. Leaves no robot behind."""
    try:
        for block in chosen:
            for command in block.commands:
                if not any(begins(command, words) for words in (*NOT_RUN, *(SLOW if terminal.quick else ()))):
                    yield terminal.run(command)
    finally:
        terminal.run("cocoro down")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sections", nargs="*", metavar="SECTION", help="the first words of a section's name")
    parser.add_argument("--frames", metavar="WxH@HZ", help="of all robots")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    wanted = [block for block in blocks() if block.section.startswith(tuple(chosen.sections) or "")]
    runs, seconds = Runs(report), 0.0
    with tempfile.TemporaryDirectory(prefix="readme-") as folder:
        terminal = Terminal(Path(folder), chosen.frames, chosen.short)
        for ran in run_blocks(wanted, terminal):
            last = (ran.output.strip().splitlines() or [""])[-1]
            line = f"{ran.code} {ran.seconds:6.1f} s  {ran.command:<60} {last[:80]}"
            runs.add(not ran.wrong, line, ran.output.splitlines())
            seconds += ran.seconds
    runs.share("commands that did as they should")
    report.value("all of them", [seconds], "s")
