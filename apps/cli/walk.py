"""All commands of `cocoro`, found by walking down from the command itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from typer.main import get_command

from apps.cli.app import app


def commands() -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """The words, the command and the context of each command that is not hidden, `cocoro` first."""
    top = get_command(app)
    yield from _below((), top, top.make_context("cocoro", ["status"], resilient_parsing=True))


def _below(words: tuple[str, ...], command: Any, context: Any) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    yield words, command, context
    if not hasattr(command, "commands"):
        return
    for name in command.list_commands(context):
        called, below, _ = command.resolve_command(context, [name])
        if below is not None and not below.hidden:
            yield from _below((*words, name), below, type(context)(below, info_name=called, parent=context))
