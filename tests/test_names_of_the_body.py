"""No part of the project knows a joint or a link by its name: a robot whose parts have other names works alike."""

from __future__ import annotations

import ast
import json
import re
import tomllib
from importlib import resources
from pathlib import Path

import pytest

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.robot import Robot
from services.executive.tasks import FetchTask

TOP = Path(__file__).parent.parent
DESCRIPTION = resources.files("cocoro").joinpath("calliope.toml").read_text(encoding="utf-8")
ROBOT = Robot.load()
NAMES = {*ROBOT.links, *ROBOT.joints}
COMMON = {"camera"}
"""Words that mean other things, too."""


def renamed() -> str:
    """The Calliope's description with other names for all links and joints. `[[camera]]` is a table."""
    return re.sub(rf"(?<!\[\[)\b({'|'.join(sorted(NAMES, key=len, reverse=True))})\b", r"its_\1", DESCRIPTION)


def on_one_line(description: str) -> str:
    """The description with all servos on one line of another name."""
    table = r"\[network\.(\w+)\]\n(?:\w.*\n)+"
    first = next(re.finditer(table, description))
    others = re.sub(table, lambda found: found[0] if found[1] == first[1] else "", description)
    return re.sub(r'network = "\w+"', 'network = "bus"', others.replace(f"[network.{first[1]}]", "[network.bus]"))


def test_the_names_stand_in_the_description_alone() -> None:
    found = []
    for folder in ("cocoro", "services", "sim", "deploy", "apps"):
        for path in (TOP / folder).rglob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            texts = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            words = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in texts]
            where = path.relative_to(TOP)
            found += [f"{where}:{word.lineno}: {word.value}" for word in words if word.value in NAMES - COMMON]
    assert not found


def test_the_renamed_description_has_no_former_name() -> None:
    data = tomllib.loads(renamed())
    assert {row["name"] for row in (*data["link"], *data["joint"])} == {f"its_{name}" for name in NAMES}


@pytest.mark.sim
def test_a_robot_with_other_names_and_one_line_fetches_as_the_calliope_does(tmp_path: Path) -> None:
    file = tmp_path / "renamed.toml"
    file.write_text(on_one_line(renamed()), encoding="utf-8")
    assert [*Robot.load(file).networks] == ["bus"]
    task = FetchTask(label="red_can")
    one, other = (
        rehearse(
            RehearsalRequest(
                task=task, description=description, body="worn", seed=3, width=160, height=120, frame_rate_hz=15.0
            )
        )
        for description in (None, str(file))
    )  # fmt: skip
    assert (one["outcome"], one["truth"]["held"]) == ("done", True)
    for result in (one, other):
        del result["wall_s"]
    assert json.loads(json.dumps(other).replace("its_", "")) == json.loads(json.dumps(one))
