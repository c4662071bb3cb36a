"""One line of `cocoro doctor`: what was looked at, whether it is well, and what to do if it is not."""

from __future__ import annotations

from typing import Literal, NamedTuple


class Check(NamedTuple):
    name: str
    state: Literal["ok", "note", "bad"]
    """A note is worth knowing, and keeps nothing from working."""
    text: str


def ok(name: str, text: str) -> Check:
    return Check(name, "ok", text)


def note(name: str, text: str) -> Check:
    return Check(name, "note", text)


def bad(name: str, text: str) -> Check:
    return Check(name, "bad", text)
