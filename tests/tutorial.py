"""Pages that are tutorials, carried out word for word: their files are written, their commands are run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sysconfig
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from places import short_folder

ROOT = Path(__file__).parent.parent
_BLOCK = re.compile(r"(?:`(?P<path>[\w./-]+)`:\n\n)?```(?P<language>\w+)\n(?P<text>.*?)```", re.DOTALL)
PATIENCE_S = 120.0


class Block(NamedTuple):
    path: str | None
    """Path of the file that it is, where the line before names one."""
    language: str
    text: str


def blocks_of(page: Path) -> list[Block]:
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(match["path"], match["language"], match["text"]) for match in found]


@contextmanager
def reader(folder: Path) -> Iterator[dict[str, str]]:
    """The environment of a reader who follows a page: a run directory and a virtual environment in `folder` on top of
    ours, so that installations of the page do not remain."""
    home = folder / "venv"
    venv.create(home, with_pip=False, symlinks=True)
    (site,) = home.glob("lib/python*/site-packages")
    (site / "ours.pth").write_text(f"import site; site.addsitedir({sysconfig.get_paths()['purelib']!r})\n")
    for command, module in (("pip", "pip"), ("pytest", "pytest -p no:cacheprovider"), ("cocoro", "apps.cli.main")):
        script = home / "bin" / command
        script.write_text(f'#!/bin/sh\nexec "{home}/bin/python" -P -m {module} "$@"\n')
        script.chmod(0o755)
    run_dir = short_folder()
    environment = os.environ | {
        "PATH": f"{home}/bin:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "COCORO_RUN_DIR": str(run_dir),
        "PIP_NO_BUILD_ISOLATION": "0",  # which is how pip spells "true" for an option that begins with "no"
        "PIP_NO_DEPS": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    try:
        yield environment
    finally:
        run("cocoro down", folder, environment)
        shutil.rmtree(run_dir)


def run(script: str, folder: Path, environment: dict[str, str]) -> str:
    """Run a script, which must succeed; returns its output."""
    command = ["bash", "-euo", "pipefail", "-c", script]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}\n{done.stderr}"
    return done.stdout
