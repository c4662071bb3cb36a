"""The page on tasks works word for word."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from tutorial import ROOT, blocks_of, reader, run

BLOCKS = blocks_of(ROOT / "docs" / "tasks.md")


def test_a_new_task_is_one_file_one_test_and_its_registration() -> None:
    files = [block.path for block in BLOCKS if block.language != "sh"]
    assert files == ["nod/pyproject.toml", "nod/nod.py", "nod/test_nod.py"]


@pytest.mark.process
@pytest.mark.sim
def test_the_page_works_word_for_word(tmp_path: Path) -> None:
    printed: list[str] = []
    with reader(tmp_path) as environment:
        for block in BLOCKS:
            if block.path is None:
                printed.append(run(block.text, tmp_path, environment))
            else:
                target = tmp_path / block.path
                target.parent.mkdir(exist_ok=True)
                target.write_text(block.text, encoding="utf-8")
        refused = run("cocoro nod --times 11 2>&1 || echo exit code $?", tmp_path, environment)
        made = run("cocoro new task greet && pip install -e greet && pytest greet", tmp_path, environment)
        listed = run("cocoro --help; cocoro rehearse --help", tmp_path, environment)
    tried, operated = printed
    assert "2 passed" in tried
    assert "How often." in tried
    assert re.search(r"^done: nod in", tried, re.MULTILINE)
    assert re.search(r"^done: nod in", operated, re.MULTILINE)
    assert "exit code 2" in refused
    assert "2 passed" in made, "so does the template"
    assert len(re.findall(r"nod +Nod the head\.", listed)) == 2
    assert sys.prefix not in operated
