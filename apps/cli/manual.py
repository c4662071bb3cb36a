"""The manual page `cocoro(1)`, made from the commands: `make manual` writes docs/cocoro.1."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

from apps.cli.listed import COMMANDS
from apps.cli.walk import commands

COMMON = ("robot", "profile", "json", "help")
"""Options that are described once for all commands."""
REHEARSE, EXAMPLE = "rehearse", "fetch"
"""A rehearsal takes the same options for every task: the page has those of one."""
ENVIRONMENT = {
    "COCORO_RUN_DIR": "Folder of the run directories: sockets, logs, claims. By default $XDG_RUNTIME_DIR/cocoro.",
    "COCORO_CAPTURE_DIR": "Folder of the captures.",
    "COCORO_LOG_DIR": "Folder of the logs, if it is not the run directory.",
    "COCORO_STATE_DIR": "Folder of the emergency stop's latch, which outlives a reboot.",
    "COCORO_DEBUG_GRACE_S": "With `up`: kill what hangs after so many seconds, not 10 (stopped: 2.5); 0 for never.",
    "COCORO_SITE": "Folder of the site; by default the current one if it has a site.toml.",
    "COCORO_LOG": "Level of the logs; `debug` also shows the traceback of an internal error.",
}
EXIT_CODES = {
    0: "Done.",
    1: "Failed: the task, or the output could not be written.",
    2: "Bad usage.",
    3: "Refused by the robot, or cancelled.",
    4: "The mesh is not there.",
}


def page() -> str:
    """The text of the page, in the macros of man(7)."""
    found = list(commands())
    (_, top, context), *below = found
    lines = [
        f'.TH COCORO 1 "" "cocoro-mesh {version("cocoro-mesh")}" "CoCoRo mesh"',
        ".SH NAME",
        "cocoro \\- start, command and watch a CoCoRo robot",
        ".SH SYNOPSIS",
        ".B cocoro",
        ".I COMMAND",
        "[\\fIOPTIONS\\fR] [\\fIARGUMENTS\\fR]",
        ".SH DESCRIPTION",
        *_paragraphs(top.help),
        ".SH OPTIONS",
        *_options(top, context),
        ".SS Options of many commands",
        *_item("--robot NAME", "Name of the robot; needed only when several are up on this machine."),
        *_item("--site [NAME@]DIR", "Reach a robot on other machines through the site in this folder, as NAME."),
        *_item("--json", "Print JSON, for scripts; an error, too, on standard output."),
        *_item("-h, --help", "Show the help of a command and exit."),
        ".SH COMMANDS",
    ]
    for words, command, its_context in below:
        if words[0] == REHEARSE and words[1:] not in ((), (EXAMPLE,)):
            continue
        if not hasattr(command, "commands") or command.invoke_without_command:
            lines += _command(words, command, its_context)
    lines += [".SH EXIT STATUS"]
    for code, text in EXIT_CODES.items():
        lines += _item(str(code), text)
    lines += [".SH ENVIRONMENT"]
    for name, text in ENVIRONMENT.items():
        lines += _item(name, text)
    return "\n".join(lines) + "\n"


def _command(words: tuple[str, ...], command: Any, context: Any) -> Iterator[str]:
    arguments = [_value(param) for param in command.params if param.param_type_name == "argument"]
    shown = (REHEARSE, "TASK") if words[0] == REHEARSE else words
    yield f'.SS "{_plain(" ".join(("cocoro", *shown, *arguments)))}"'
    if words[0] == REHEARSE:
        yield from _paragraphs("Try a task in simulation. Each can be rehearsed, with its own options; here `fetch`.")
    yield from _paragraphs(command.help or next(row.summary for row in COMMANDS if row.name == words[0]))
    yield from _options(command, context)


def _value(param: Any) -> str:
    """The word that stands for the value of an argument or an option."""
    return str(param.metavar or param.name.upper())


def _options(command: Any, context: Any) -> Iterator[str]:
    for param in command.params:
        text = getattr(param, "help", None) or ""
        if param.param_type_name == "argument":
            yield from _item(_value(param), text)
        elif param.name not in COMMON and not getattr(param, "hidden", False):
            names = ", ".join((*param.opts[::-1], *param.secondary_opts))
            value = "" if getattr(param, "is_flag", False) else f" {_value(param)}"
            default = param._extract_default_help_str(ctx=context) if param.show_default else None
            words = "" if default in (None, False, (), []) or callable(default) else f" Default: {default}."
            yield from _item(f"{names}{value}", f"{text}{words}")


def _item(head: str, text: str) -> Iterator[str]:
    if not text:
        return
    yield ".TP"
    yield f"\\fB{_plain(head)}\\fR"
    yield _plain(text)


def _paragraphs(text: str) -> Iterator[str]:
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        yield ".PP"
        yield _plain(paragraph)


def _plain(text: str) -> str:
    """Text in which the page's program finds nothing to carry out; backquotes become bold."""
    text = " ".join(text.replace("\\[", "[").split()).replace("\\", "\\e").replace("-", "\\-").replace('"', "\\(dq")
    text = re.sub(r"`([^`]*)`", r"\\fB\1\\fR", text)
    return f"\\&{text}" if text.startswith((".", "'")) else text


if __name__ == "__main__":
    print(page(), end="")
