"""Display of a task's progress on a terminal: one line rewritten in place, the finished phases above it."""

from __future__ import annotations

import io
import re

import pytest

from apps.cli.progress import LiveDisplay
from cocoro.messages import TaskState


class Terminal(io.StringIO):
    """A terminal that knows what rich uses of it: line ends, erasing a line, and going up."""

    def isatty(self) -> bool:
        return True

    @property
    def screen(self) -> list[str]:
        lines, row = [""], 0
        for token in re.findall(r"\x1b\[\??\d*[A-Za-z]|\r|\n|[^\x1b\r\n]+", self.getvalue()):
            if token == "\n":
                row += 1
                lines += [""] * (row == len(lines))
            elif token == "\x1b[2K":
                lines[row] = ""
            elif token == "\x1b[1A":
                row -= 1
            elif not token.startswith(("\x1b", "\r")):
                lines[row] += token
        return "\n".join(lines).rstrip("\n").split("\n")


def test_on_a_terminal_one_line_is_written_over_and_each_phases_last_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("TERM", "xterm")
    out = Terminal()
    live = LiveDisplay(out)
    for elapsed_s, phase in ((0.1, "search"), (0.5, "search"), (0.7, "approach")):
        live.show(TaskState(phase=phase, elapsed_s=elapsed_s, text="a text that is much too long for this"))
    assert out.screen == [
        "   0.5 s  search               a text that is much too long for this",
        "   0.7 s  approach             a text t…",
    ]
    live.result("done: fetch red_can in 0.9 s")
    assert out.screen == [
        "   0.5 s  search               a text that is much too long for this",
        "   0.7 s  approach             a text that is much too long for this",
        "done: fetch red_can in 0.9 s",
    ]


def test_text_beside_the_progress_stands_above_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    out = Terminal()
    live = LiveDisplay(out)
    live.show(TaskState(phase="search", elapsed_s=0.1))
    live.say("cancelling fetch red_can")
    assert out.screen == ["cancelling fetch red_can", "   0.1 s  search"]
    live.close()
    assert out.screen == ["cancelling fetch red_can"]
