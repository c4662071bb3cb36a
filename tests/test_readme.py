"""The blocks of the README, and which of their commands are run (`bench/readme.py`)."""

from __future__ import annotations

from pathlib import Path

from bench.readme import NOT_RUN, SLOW, begins, blocks


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
