"""The lines of `cocoro doctor`: what was checked, the result, and what to do about a problem."""

from __future__ import annotations

from typing import Literal, NamedTuple


class Check(NamedTuple):
    """One line."""

    name: str
    state: Literal["ok", "note", "bad"]
    """A `note` is information: everything works nevertheless."""
    text: str


def ok(name: str, text: str) -> Check:
    return Check(name, "ok", text)


def note(name: str, text: str) -> Check:
    return Check(name, "note", text)


def bad(name: str, text: str) -> Check:
    return Check(name, "bad", text)
