"""The blocks of the README run in order, as they are written, as a new user gives them."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import in_short_folder

from bench.readme import NOT_RUN, SLOW, Terminal, begins, blocks, run_blocks

FRAMES = "320x240@15"
REHEARSE = "Rehearse"


def failures(sections: tuple[str, ...]) -> list[str]:
    """The commands of the sections that did not end as the README promises, with what they printed."""
    chosen = [block for block in blocks() if block.section.startswith(sections)]
    assert len({block.section for block in chosen}) == len(sections)
    with in_short_folder() as folder:
        ran = list(run_blocks(chosen, Terminal(folder, FRAMES, quick=True)))
    assert ran
    return [f"{one.command}: exit code {one.code}\n{one.output}" for one in ran if one.wrong]


def test_every_command_that_is_left_out_is_in_the_readme_and_has_a_reason() -> None:
    commands = [command for block in blocks() for command in block.commands]
    for words, reason in {**NOT_RUN, **SLOW}.items():
        assert any(begins(command, words) for command in commands), f"{words} is in no block"
        assert reason


def test_a_block_is_its_commands_without_comments(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("## One\n\n```sh\nmake it    # so\n# nothing\nrun 'a # b'\n```\n## Two\n```toml\nx = 1\n```\n")
    (block,) = blocks(page)
    assert (block.section, block.commands) == ("One", ("make it", "run 'a # b'"))


@pytest.mark.zenoh  # its `cocoro stop` stops every robot of this machine
@pytest.mark.sim
@pytest.mark.process
def test_the_robot_is_operated_looked_into_and_replayed_as_written() -> None:
    wrong = failures(
        ("Operate the robot", "Look into it", "Teach it a new object", "Capture, replay, look", "The real robot")
    )
    assert not wrong, "\n\n".join(wrong)


@pytest.mark.sim
@pytest.mark.process
def test_the_rehearsals_are_run_as_written() -> None:
    wrong = failures((REHEARSE,))
    assert not wrong, "\n\n".join(wrong)
