"""Sizes of the installations by extra, each in a fresh virtual environment, and what works in it.

python -m bench.installs                  # without an extra, operator, robot, sim
python -m bench.installs operator         # one of them
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench.ended import leave_when_ended

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("extras", nargs="*", default=EXTRAS, metavar="EXTRA")
    asked = parser.parse_args()
    leave_when_ended()
    with tempfile.TemporaryDirectory() as folder:
        _run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, str(ROOT)])
        (wheel,) = Path(folder).glob("*.whl")
        for extra in asked.extras:
            measure(extra, wheel, Path(folder) / f"venv-{extra}")


def measure(extra: str, wheel: Path, venv: Path) -> None:
    """Installs into a fresh environment and prints its size and what each command says."""
    _run([sys.executable, "-m", "venv", str(venv)])
    what = f"cocoro-mesh[{extra}]" if extra else "cocoro-mesh"
    begun_s = time.monotonic()
    pip = [str(venv / "bin" / "pip"), "install", "-q", "--disable-pip-version-check"]
    _run([*pip, "-c", str(ROOT / "constraints.txt"), f"{what} @ {wheel.as_uri()}"])
    print(f"\n== {what}: installed in {time.monotonic() - begun_s:.0f} s", flush=True)
    _run([str(venv / "bin" / "python"), str(ROOT / "deploy" / "install_progress.py"), "sizes"])
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(venv), "COCORO_RUN_DIR": str(venv / "run")}

    def cocoro(*words: str) -> subprocess.CompletedProcess[str]:
        command = [str(venv / "bin" / "cocoro"), *words]
        return subprocess.run(
            command, cwd=venv, env=environment, capture_output=True, text=True, timeout=300, check=False
        )

    try:
        _probe(cocoro)
    finally:
        cocoro("down")


def _probe(cocoro: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    for words in PROBES:
        done = cocoro(*words)
        said = ((done.stderr or done.stdout).strip().splitlines() or [""])[-1]
        print(f"  {done.returncode}  cocoro {' '.join(words).replace(GOLDEN, 'FILE'):<42} {said[:110]}")


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, stderr=None if "python" in command[0] else subprocess.DEVNULL)


if __name__ == "__main__":
    main()
