"""The page on the client works word for word, without a robot."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from tutorial import ROOT, blocks_of

from apps.client.robot import RobotClient
from cocoro.messages import RefusalCode
from cocoro.task_errors import REFUSALS

PAGE = ROOT / "docs" / "client.md"
PATIENCE_S = 900.0


@pytest.mark.process
@pytest.mark.sim
def test_the_programs_of_the_page_run_as_they_are_written(tmp_path: Path) -> None:
    shutil.copy(ROOT / "tests" / "golden" / "fetch.mcap", tmp_path / "docs-capture.mcap")
    printed = []
    for number, block in enumerate(blocks_of(PAGE)):
        if block.language != "python":  # it needs a robot that is up; tests/test_client_live.py does the same
            continue
        program = tmp_path / (block.path or f"block{number}.py")
        program.write_text(block.text, encoding="utf-8")
        if block.path is None:  # the first one needs a robot; the second one runs it in virtual time
            printed.append(run(program))
    rehearsed, refused, seen, driven, read = printed
    phases = [line.split()[-1] for line in rehearsed.splitlines()[:-1]]
    assert phases[-1] == "end"
    assert {"search", "approach", "grasp", "lift"} <= {*phases}
    assert float(rehearsed.splitlines()[-1]) > 1.0
    assert "unknown object 'teapot'" in refused
    assert refused.splitlines()[-1] == "timed_out"
    assert "red_can" in seen
    assert driven == ""
    assert "red_can" in read


def run(program: Path) -> str:
    done = subprocess.run(
        [sys.executable, str(program)], cwd=program.parent, env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_page_names_every_refusal_and_every_method() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [code for code in get_args(RefusalCode) if f"`{code}`" not in text] == []
    assert [kind.__name__ for kind in REFUSALS.values() if f"`{kind.__name__}`" not in text] == []
    methods = [name for name in vars(RobotClient) if not name.startswith("_")]
    apart = {"name", "end"}  # what only the makers of a client need
    assert [name for name in methods if f"robot.{name}(" not in text and name not in apart] == []
