"""The emulated firmware as a process: `python -m sim.wire.process --fd N DIR`, started by `sim.wire.service`.

It ends when the other end of its socket closes.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path

from sim.wire.control import Control, ControlServer
from sim.wire.emulator import Device, Emulator
from sim.wire.link import Channel, LinkedBody, Setup, firmware

PREFERRED = -10


class _Ending(Emulator):
    """Ends when its body is gone."""

    linked: LinkedBody

    def _take_jobs(self) -> bool:
        return super()._take_jobs() and self.linked.connected


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.wire.process", description="Emulated firmware on wires.")
    parser.add_argument("folder", type=Path, help="where the ports are to be")
    parser.add_argument("--fd", type=int, required=True, help="this process's end of a socket pair")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started it
    with suppress(PermissionError):
        os.nice(PREFERRED)  # firmware answers at once
    channel = Channel(socket.socket(fileno=options.fd))
    select.select([channel], [], [], 30.0)
    setup = channel.newest(Setup)
    if setup is None:
        return 1
    create, lines = firmware(setup)
    devices: dict[str, Device] = {"create": create, **lines}
    body = LinkedBody(channel, create, lines)
    emulator = _Ending(options.folder, devices, body, setup.seed)
    emulator.linked = body
    with ControlServer(options.folder, Control(emulator)):
        emulator.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
