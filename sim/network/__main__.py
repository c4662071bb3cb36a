"""The switch's process: `python -m sim.network FD`, where FD is its end of the owner's socket pair."""

from __future__ import annotations

import signal
import socket
import sys

from sim.network import switch

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner, whose end ends this process
    switch.serve(socket.socket(fileno=int(sys.argv[1])))
