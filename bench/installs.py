"""Measures the installations by extra, each in a fresh environment, and tries commands: `python -m bench installs`.

python -m bench installs                  # without an extra, operator, robot, sim
python -m bench installs operator         # one of them
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.report import Report, Table

ROOT = Path(__file__).parent.parent
EXTRAS = ("", "operator", "robot", "sim")
GOLDEN = str(ROOT / "tests" / "golden" / "fetch.mcap")
PROBES = (
    ("--help",),
    ("up", "--help"),
    ("topics",),
    ("status",),
    ("top", "--once"),
    ("fetch", "red_can"),
    ("stop",),
    ("snapshot", "now.png"),
    ("capture", "info", GOLDEN),
    ("export", GOLDEN, "--video", "fetch.mp4"),
    ("capture", "reexecute", GOLDEN, "--service", "planning"),
    ("doctor", "sim"),
    ("doctor", "robot"),
    ("up", "robot", "--detach"),
    ("up", "sim", "--detach"),
    ("down",),
    ("rehearse", "park"),
)
"""Commands that are tried where no robot is up."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("extras", nargs="*", metavar="EXTRA", help="an extra; '' for the installation without one")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    with tempfile.TemporaryDirectory() as folder:
        _run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, str(ROOT)])
        (wheel,) = Path(folder).glob("*.whl")
        for extra in chosen.extras or EXTRAS[: 1 if chosen.short else None]:
            _installation(report, extra, wheel, Path(folder) / f"venv-{extra}")


def _installation(report: Report, extra: str, wheel: Path, venv: Path) -> None:
    """Installs into a fresh environment; reports its time and size, and what each command says."""
    _run([sys.executable, "-m", "venv", str(venv)])
    what = f"cocoro-mesh[{extra}]" if extra else "cocoro-mesh"
    begun_s = time.monotonic()
    pip = [str(venv / "bin" / "pip"), "install", "-q", "--disable-pip-version-check"]
    _run([*pip, "-c", str(ROOT / "constraints.txt"), f"{what} @ {wheel.as_uri()}"])
    report.value(f"{what}: installed in", [time.monotonic() - begun_s], "s")
    sizes = _run([str(venv / "bin" / "python"), str(ROOT / "deploy" / "install_progress.py"), "sizes"])
    report.notes += [f"{what}: {' '.join(line.split())}" for line in sizes.splitlines() if line.strip()]
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(venv), "COCORO_RUN_DIR": str(venv / "run")}

    def cocoro(*words: str) -> subprocess.CompletedProcess[str]:
        command = [str(venv / "bin" / "cocoro"), *words]
        return subprocess.run(
            command, cwd=venv, env=environment, capture_output=True, text=True, timeout=300, check=False
        )

    rows = []
    try:
        for words in PROBES:
            done = cocoro(*words)
            said = ((done.stderr or done.stdout).strip().splitlines() or [""])[-1]
            rows.append([f"cocoro {' '.join(words).replace(GOLDEN, 'FILE')}", str(done.returncode), said[:110]])
            report.say("  ".join(rows[-1]))
    finally:
        cocoro("down")
    report.tables.append(Table(f"What works with {what}", ["command", "exit code", "its last words"], rows))


def _run(command: list[str]) -> str:
    """What a command printed. Raises CalledProcessError for one that failed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment).stdout
