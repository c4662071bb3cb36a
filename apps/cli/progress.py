"""A task's progress, as it is shown: one live line where a person watches, a line a phase elsewhere, nothing for
scripts that want JSON."""

from __future__ import annotations

import shutil
import sys
from typing import Protocol, TextIO

from cocoro.messages import TaskState

EVERY_S = 2.0
"""How often a long phase gets a further line, where lines are not written over."""


class TaskDisplay(Protocol):
    def show(self, state: TaskState) -> None: ...

    def say(self, text: str) -> None:
        """Something beside the progress."""

    def result(self, text: str) -> None:
        """The last line."""


def view(as_json: bool, out: TextIO | None = None) -> TaskDisplay:
    out = out or sys.stdout
    if as_json:
        return SilentDisplay()
    return LiveDisplay(out) if out.isatty() else LineDisplay(out)


def line(state: TaskState) -> str:
    distance = "" if state.distance_m is None else f"{state.distance_m:6.2f} m"
    return f"{state.elapsed_s:6.1f} s  {state.phase:<10} {distance:<8}  {state.text}".rstrip()


class SilentDisplay:
    def show(self, state: TaskState) -> None:
        pass

    def say(self, text: str) -> None:
        print(text, file=sys.stderr)

    def result(self, text: str) -> None:
        pass


class LineDisplay:
    """A line for each phase, and one now and then while it lasts."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._begun: tuple[int, str] | None = None
        self._shown: tuple[int, str] | None = None
        self._shown_s = 0.0

    def show(self, state: TaskState) -> None:
        phase = (len(state.phases), state.phase)
        begins, self._begun = phase != self._begun, phase
        if begins:  # what a phase begins with is still the last one's reason and distance
            return
        if phase != self._shown or state.elapsed_s - self._shown_s >= EVERY_S:
            self._shown, self._shown_s = phase, state.elapsed_s
            self.say(line(state))

    def say(self, text: str) -> None:
        print(text, file=self._out, flush=True)

    def result(self, text: str) -> None:
        self.say(text)


class LiveDisplay:
    """A line that is written over; what a phase came to stays above it."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._last: TaskState | None = None

    def show(self, state: TaskState) -> None:
        before = self._last
        if before is not None and (len(before.phases), before.phase) != (len(state.phases), state.phase):
            self._write(line(before) + "\n")
        self._last = state
        self._write(line(state))

    def say(self, text: str) -> None:
        self._write(text + "\n")
        if self._last is not None:
            self._write(line(self._last))

    def result(self, text: str) -> None:
        if self._last is not None:
            self._write(line(self._last) + "\n")
            self._last = None
        self._write(text + "\n")

    def _write(self, text: str) -> None:
        width = shutil.get_terminal_size().columns - 1
        end = "\n" if text.endswith("\n") else ""
        self._out.write(f"\r\x1b[K{text.rstrip()[:width]}{end}")
        self._out.flush()
