"""The tutorial on components works word for word: its files are written, its commands are run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from places import short_folder

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "components.md"
_BLOCK = re.compile(r"(?:`(?P<path>[\w./-]+)`:\n\n)?```(?P<language>\w+)\n(?P<text>.*?)```", re.DOTALL)
PATIENCE_S = 120.0


class Block(NamedTuple):
    path: str | None
    """The path of the file, if the line before the block names one."""
    language: str
    text: str


def blocks() -> list[Block]:
    found = _BLOCK.finditer(PAGE.read_text(encoding="utf-8"))
    return [Block(match["path"], match["language"], match["text"]) for match in found]


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    """A virtual environment on top of ours, so that what the page installs is gone afterwards."""
    home = tmp_path / "venv"
    venv.create(home, with_pip=False, symlinks=True)
    (site,) = home.glob("lib/python*/site-packages")
    (site / "ours.pth").write_text(f"import site; site.addsitedir({sysconfig.get_paths()['purelib']!r})\n")
    for command, module in (("pip", "pip"), ("pytest", "pytest -p no:cacheprovider"), ("cocoro", "apps.cli.main")):
        script = home / "bin" / command
        script.write_text(f'#!/bin/sh\nexec "{home}/bin/python" -P -m {module} "$@"\n')
        script.chmod(0o755)
    run_dir = short_folder()
    yield os.environ | {
        "PATH": f"{home}/bin:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "COCORO_RUN_DIR": str(run_dir),
        "PIP_NO_BUILD_ISOLATION": "0",  # which is how pip spells "true" for an option that begins with "no"
        "PIP_NO_DEPS": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    shutil.rmtree(run_dir)


def run(script: str, folder: Path, environment: dict[str, str]) -> str:
    command = ["bash", "-euo", "pipefail", "-c", script]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_every_piece_of_python_says_which_file_it_is() -> None:
    pieces = [block for block in blocks() if block.language != "sh"]
    assert len(pieces) == 6
    assert all(block.path for block in pieces)


@pytest.mark.process
@pytest.mark.sim
def test_the_tutorial_works_word_for_word(tmp_path: Path, environment: dict[str, str]) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    printed: list[str] = []
    try:
        for block in blocks():
            if block.path is None:
                printed.append(run(block.text, folder, environment))
            else:
                target = folder / block.path
                if target.suffix == ".py":
                    assert target.is_file(), f"{block.path} is not in the template"
                target.write_text(block.text, encoding="utf-8")
    finally:
        run("cocoro down", folder, environment)
    made, tested, operated = printed
    assert "6 passed" in made
    assert "2 passed" in tested
    assert re.search(r"^nearest/object +Nearest +2 Hz +2 s +state +nearest +yes", operated, re.MULTILINE)
    assert "calliope/nearest/object  Nearest  #" in operated
    assert re.search(r"^nearest +ready", operated, re.MULTILINE)
    assert re.search(r"^calliope/nearest/object +\d\.\d Hz +2\.0 Hz", operated, re.MULTILINE)
    assert "nearest: nearest.service with NearestConfig(rate_hz=5.0, within_m=3.0)" in operated
    assert re.search(r"^nearest: \d+ steps, \d+ outputs compared: every one equal", operated, re.MULTILINE)
    assert sys.prefix not in operated
