"""Judges whether `cocoro view` ends where nobody can see it, each with a reason: `python -m bench viewer [FILE]`.

Starts it without a display, with a display that is not there, with nobody at the other end, with somebody who takes
nothing, into a file, and as a page. None may hang. Needs the extra `view`. Without FILE a fetch is rehearsed for it.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import socket
import subprocess
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

from bench.exports import COCORO, FETCHES, rehearsed
from bench.report import Report, Table
from bench.trials import Runs
from cocoro.errors import CocoroError

ENDS_S = 60.0
"""A command that has not ended by then hangs."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", type=Path, metavar="FILE", help="a capture")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if find_spec("rerun") is None:
        raise CocoroError("this needs Rerun: pip install 'cocoro-mesh[view]'")
    if chosen.file is not None and not chosen.file.is_file():
        raise CocoroError(f"{chosen.file}: there is no such file")
    bare = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    runs, rows = Runs(report), []
    with tempfile.TemporaryDirectory() as place, socket.create_server(("127.0.0.1", 0)) as mute:
        folder = Path(place)
        file = str(chosen.file or rehearsed(next(iter(FETCHES.values())), folder / "fetch.mcap"))
        port = mute.getsockname()[1]
        cases = {
            "no display": ([file], bare, ""),
            "a display that is not there": ([file], {**bare, "DISPLAY": ":77"}, ""),
            "nobody there": ([file, "--connect", "127.0.0.1:1"], bare, ""),
            "somebody who takes nothing": ([file, "--connect", f"127.0.0.1:{port}"], bare, ""),
            "a file": ([file, "--save", str(folder / "view.rrd")], bare, ""),
            "a page": ([file, "--web"], bare, "Ctrl-C"),
        }
        for name, (words, env, interrupt_at) in cases.items():
            said = ended(words, env, interrupt_at)
            runs.add(not said.startswith("HANGS"), f"{name}: {said}")
            rows.append([name, said])
    runs.share("ended by itself, or at Ctrl-C")
    report.tables.append(Table("How it ended", ["where", "end"], rows))


def ended(words: list[str], env: dict[str, str], interrupt_at: str) -> str:
    """Run `cocoro view` and describe its end. With `interrupt_at` Ctrl-C follows these words of it."""
    started_s = time.monotonic()
    process = subprocess.Popen(
        [*COCORO, "view", *words], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    heard = ""
    if interrupt_at and process.stdout is not None:
        for line in process.stdout:
            heard += line
            if interrupt_at in line:
                heard += listeners(heard)
                process.send_signal(signal.SIGINT)
                break
    try:
        out, err = process.communicate(timeout=ENDS_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return f"HANGS: no end within {ENDS_S:.0f} s"
    words_heard = " / ".join((heard + out + err).split("\n")).strip(" /")
    return f"exit code {process.returncode} after {time.monotonic() - started_s:.1f} s: {words_heard}"


def listeners(heard: str) -> str:
    """The addresses on which the page and its data are served."""
    ports = re.findall(r":(\d+)|%3A(\d+)%2Fproxy", heard)
    numbers = {f"{int(port):04X}" for pair in ports for port in pair if port}
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for row in Path(table).read_text().splitlines()[1:]:
            address, port = row.split()[1].split(":")
            if port in numbers and row.split()[3] == "0A":
                found.add("loopback" if address == "0100007F" else f"address {address}")
    return f"served on {', '.join(sorted(found)) or 'nothing'}\n"
