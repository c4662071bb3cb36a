"""The camera's process: `python -m sim.camera_process FD`, where FD is its end of the channel."""

from __future__ import annotations

import os
import signal
import socket
import sys
from typing import NoReturn


def serve(channel: socket.socket) -> NoReturn:
    """Serve the other end of the channel until it closes, and end this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner, whose end ends this process
    code = 1
    try:
        from sim.camera_process import serving

        serving.serve(channel)
        code = 0
    except ConnectionError:
        code = 0  # the owner has ended
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        os._exit(code)  # the system frees memory and OpenGL's context sooner than their destructors do


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
