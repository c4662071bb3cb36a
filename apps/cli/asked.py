"""Asks a robot's supervisor for the report of `cocoro status`.

The supervisor takes some milliseconds to collect it. So it is asked before the modules that print the report are
imported, and this module imports next to nothing.
"""

from __future__ import annotations

import _socket as socket  # the module of that name makes enumerations and takes 2 ms to import

TYPE_CHECKING = False
"""As in `typing`, which takes 2 ms to import."""
if TYPE_CHECKING:
    from pathlib import Path

ANSWER_S = 3.5
"""Longest wait for the supervisor's answer. It waits itself for `deploy.survey.HEALTH_S` where a service is silent."""
PIECE_BYTES = 65536


class Asked:
    """A question to the supervisor that listens at this socket. The constructor asks it; where none listens, there is
    no answer."""

    def __init__(self, survey_socket: Path) -> None:
        self._line: socket.socket | None = None
        line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            line.settimeout(ANSWER_S)
            line.connect(str(survey_socket))
        except OSError:
            line.close()
        else:
            self._line = line

    def answer(self) -> bytes:
        """The answer, once; empty without one."""
        line, self._line = self._line, None
        if line is None:
            return b""
        pieces = []
        try:
            while piece := line.recv(PIECE_BYTES):
                pieces.append(piece)
        except OSError:
            return b""
        finally:
            line.close()
        return b"".join(pieces)
