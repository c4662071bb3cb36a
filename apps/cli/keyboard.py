"""Single keys from the terminal, without Enter."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LEFT, RIGHT = ("\x1b[D", "\x1bOD"), ("\x1b[C", "\x1bOC")
UP, DOWN = ("\x1b[A", "\x1bOA"), ("\x1b[B", "\x1bOB")
QUIT = ("q", "\x03", "\x04", "")
"""Keys that end a command; the empty text is the end of the input."""
_KEY = re.compile(r"\x1b[\[O][A-Z]|.", re.DOTALL)
"""One key press; a read may return several when they come quickly, as from a key that is held down."""


@contextmanager
def keyboard(pressed: Callable[[str], None]) -> Iterator[bool]:
    """Calls `pressed` with each key's text while the context lasts; yields False when standard input is no terminal."""
    if not sys.stdin.isatty():
        yield False
        return
    fd, loop = sys.stdin.fileno(), asyncio.get_running_loop()
    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)

    def read() -> None:
        for key in _KEY.findall(os.read(fd, 32).decode(errors="replace")) or [""]:
            pressed(key)

    loop.add_reader(fd, read)
    try:
        yield True
    finally:
        loop.remove_reader(fd)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
