"""The tutorial on components works word for word: its files are written, its commands are run."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from tutorial import ROOT, blocks_of, reader, run

BLOCKS = blocks_of(ROOT / "docs" / "components.md")


def test_every_piece_of_python_says_which_file_it_is() -> None:
    pieces = [block for block in BLOCKS if block.language != "sh"]
    assert len(pieces) == 6
    assert all(block.path for block in pieces)


@pytest.mark.process
@pytest.mark.sim
def test_the_tutorial_works_word_for_word(tmp_path: Path) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    printed: list[str] = []
    with reader(tmp_path) as environment:
        for block in BLOCKS:
            if block.path is None:
                printed.append(run(block.text, folder, environment))
            else:
                target = folder / block.path
                if target.suffix == ".py":
                    assert target.is_file(), f"{block.path} is not in the template"
                target.write_text(block.text, encoding="utf-8")
    made, tested, operated = printed
    assert "6 passed" in made
    assert "2 passed" in tested
    assert re.search(r"^nearest/object +Nearest +2 Hz +2 s +state +nearest +yes", operated, re.MULTILINE)
    assert "calliope/nearest/object  Nearest  #" in operated
    assert re.search(r"^nearest +ready", operated, re.MULTILINE)
    assert re.search(r"^nearest/object +\d\.\d Hz +2\.0 Hz", operated, re.MULTILINE)
    assert "nearest: nearest.service with rate_hz = 5.0" in operated
    assert re.search(r"^nearest: \d+ steps, \d+ outputs compared: every one equal", operated, re.MULTILINE)
    assert sys.prefix not in operated
