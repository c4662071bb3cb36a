"""Former spellings of options: still taken, and shown nowhere."""

from __future__ import annotations

from typing import Any

FORMER = {"--description": "--robot"}


def taking_former(command: Any) -> Any:
    """The command, which takes the former spelling of each option that it has and no other option is called by; so do
    those below it."""
    for below in getattr(command, "commands", {}).values():
        taking_former(below)
    names = {name for part in command.params for name in part.opts}
    renamed = {old: new for old, new in FORMER.items() if new in names and old not in names}
    if renamed:
        parse = command.parse_args
        command.parse_args = lambda ctx, args: parse(ctx, _renamed(args, renamed))
    return command


def _renamed(args: list[str], renamed: dict[str, str]) -> list[str]:
    """The arguments by today's names; what follows `--` is no option."""
    end = args.index("--") if "--" in args else len(args)
    found = []
    for word in args[:end]:
        name, equals, value = word.partition("=")
        found.append(f"{renamed[name]}{equals}{value}" if name in renamed else word)
    return found + args[end:]
