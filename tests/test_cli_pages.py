"""Every `cocoro` command that the README and the pages of docs/ show is one that there is, with options that it has."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_group

from apps.cli.app import app

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(cocoro [^`]+)`")
THIRD_PARTY = ("nod", "rehearse nod")
"""Commands of what a page installs."""
EAGER = {"-h", "--help", "--version", "--install-completion"}
"""Options that act while they are read; `cocoro --help` lists them."""
ENDS = ("|", "&", "&&", ";", ">", ">>", "2>")


def shown(page: Path) -> Iterator[tuple[str, bool]]:
    """The command lines of a page, and whether each is whole: in a shell block, not in a sentence."""
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            for command in re.findall(r"(?:^|[;&|] *|\bsudo -u \w+ +)(cocoro [^;&|]*)", line.strip()):
                yield command, True
    for command in INLINE.findall(" ".join(BLOCK.sub("", text).split())):
        yield command, False


def arguments(line: str) -> list[str]:
    """The words of a command line without comment, redirection and brackets; a capital letter stands for a number."""
    words = shlex.split(line, comments=True)[1:]
    end = next((number for number, word in enumerate(words) if word in ENDS), len(words))
    return [re.sub(r"^[A-Z]$", "1", word.strip("[]")) for word in words[:end] if word not in ("...", "…")]


def parse(group: Any, name: str, words: list[str], parent: Any = None) -> None:
    """Read the words as the command would, without carrying it out."""
    context = group.make_context(name, words, parent=parent)
    rest = [*getattr(context, "_protected_args", ()), *context.args]
    if hasattr(group, "commands") and rest:
        called, command, rest = group.resolve_command(context, rest)
        parse(command, called, rest, context)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_of_a_page_can_be_given_as_they_are_written(page: Path) -> None:
    wrong = []
    for line, whole in dict.fromkeys(shown(page)):
        words = arguments(line)
        if not words or ("..." in line and not whole) or EAGER & {*words} or words[0] in ("stop", "estop"):
            continue
        if words[0] in THIRD_PARTY or " ".join(words[:2]) in THIRD_PARTY:
            continue
        try:
            parse(get_group(app), "cocoro", words)
        except BaseException as error:
            kind = type(error).__name__
            if whole or kind not in ("MissingParameter", "BadOptionUsage"):  # a sentence may leave arguments out
                wrong.append(f"{line.strip()}: {kind}: {error}")
    assert not wrong, "\n".join(wrong)
