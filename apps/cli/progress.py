"""Display of a task's progress by a command: one line rewritten in place on a terminal, lines for each phase
elsewhere, and nothing with `--json`."""

from __future__ import annotations

import sys
from typing import Protocol, TextIO

from apps.cli.terminal import StatusLine
from cocoro.messages import TaskState

EVERY_S = 2.0
"""Time of a phase between two of its lines, where no line can be rewritten."""


class TaskDisplay(Protocol):
    def show(self, state: TaskState) -> None:
        """Shows a state of the task."""

    def say(self, text: str) -> None:
        """Prints a line beside the progress."""

    def result(self, text: str) -> None:
        """Prints the last line."""

    def close(self) -> None:
        """Leaves the terminal as it was; needed when the command ends without a result."""


def task_display(as_json: bool, out: TextIO | None = None) -> TaskDisplay:
    """The display for `out`, standard output by default."""
    out = out or sys.stdout
    if as_json:
        return SilentDisplay()
    return LiveDisplay(out) if out.isatty() else LineDisplay(out)


def line(state: TaskState) -> str:
    distance = "" if state.distance_m is None else f"{state.distance_m:6.2f} m"
    return f"{state.elapsed_s:6.1f} s  {state.phase:<10} {distance:<8}  {state.text}".rstrip()


class SilentDisplay:
    """Shows nothing on standard output, which is for JSON."""

    def show(self, state: TaskState) -> None:
        pass

    def say(self, text: str) -> None:
        print(text, file=sys.stderr)

    def result(self, text: str) -> None:
        pass

    def close(self) -> None:
        pass


class LineDisplay:
    """Prints a line for each phase, and one every EVERY_S while it lasts."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._begun: tuple[int, str] | None = None
        self._shown: tuple[int, str] | None = None
        self._shown_s = 0.0

    def show(self, state: TaskState) -> None:
        phase = (len(state.phases), state.phase)
        begins, self._begun = phase != self._begun, phase
        if begins:  # the first state of a phase still has the reason and distance of the phase before
            return
        if phase != self._shown or state.elapsed_s - self._shown_s >= EVERY_S:
            self._shown, self._shown_s = phase, state.elapsed_s
            self.say(line(state))

    def say(self, text: str) -> None:
        print(text, file=self._out, flush=True)

    def result(self, text: str) -> None:
        self.say(text)

    def close(self) -> None:
        pass


class LiveDisplay:
    """Rewrites one line in place; the last line of each finished phase stays above it."""

    def __init__(self, out: TextIO) -> None:
        self._line = StatusLine(out)
        self._last: TaskState | None = None

    def show(self, state: TaskState) -> None:
        before = self._last
        if before is not None and (len(before.phases), before.phase) != (len(state.phases), state.phase):
            self._line.print(line(before))
        self._last = state
        self._line.show(line(state))

    def say(self, text: str) -> None:
        self._line.print(text)
        if self._last is not None:
            self._line.show(line(self._last))

    def result(self, text: str) -> None:
        self._line.close()
        if self._last is not None:
            self._line.print(line(self._last))
            self._last = None
        self._line.print(text)

    def close(self) -> None:
        self._line.close()
