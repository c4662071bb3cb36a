"""CONTRIBUTING.md: its commands, files and markers exist."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from apps.cli.main import main
from bench.__main__ import WORDS
from bench.entries import ENTRIES

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
CODE = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", TEXT, flags=re.DOTALL))
BLOCKS = re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
LINES = [line.partition("#")[0].strip() for block in BLOCKS for line in block.splitlines()]
COMMANDS = [command for command in (*CODE, *LINES) if " " in command]


def test_links_and_paths_lead_to_files() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", TEXT)
    paths = [code for code in CODE if re.fullmatch(r"[\w*./-]+(\.(py|toml|mcap|txt)|/)", code)]
    assert len(paths) > 10
    missing = [path for path in (*links, *paths) if not list(ROOT.glob(re.sub("NAME|X(?=.py)", "*", path).rstrip("/")))]
    assert missing == []


def test_targets_of_make_and_benches_exist() -> None:
    targets = set(re.findall(r"(?m)^(\w+):", (ROOT / "Makefile").read_text()))
    assert {command.split()[1] for command in COMMANDS if command.startswith("make ")} <= targets
    benches = {command.split()[3] for command in COMMANDS if command.startswith("python -m bench ")} - {"NAME"}
    assert benches
    assert benches <= {*ENTRIES, *WORDS}


def test_commands_of_the_command_line_exist() -> None:
    named = {command.split()[1] for command in COMMANDS if command.startswith("cocoro ")}
    assert len(named) >= 4
    assert {name: main([name, "--help"]) for name in named} == dict.fromkeys(named, 0)


@pytest.mark.parametrize("marker", ["process", "sim", "sweep", "zenoh"])
def test_markers_are_those_of_pytest_and_of_make_unit(marker: str) -> None:
    markers = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]["markers"]
    assert marker in CODE
    assert any(line.startswith(f"{marker}:") for line in markers)
    assert f"not {marker}" in (ROOT / "Makefile").read_text()
