"""A page of the bench `cockpit-pictures`, as a process of its own: acknowledges pictures, and counts what comes.

python -m bench.cockpit_viewer PORT SECONDS
"""

from __future__ import annotations

import json
import struct
import sys
import time
from typing import Any

from websockets.sync.client import ClientConnection, connect

WAIT_S = 0.2


def header_of(picture: bytes) -> dict[str, Any]:
    """The header of a picture's message."""
    (length,) = struct.unpack_from("<I", picture)
    header: dict[str, Any] = json.loads(picture[4 : 4 + length])
    return header


def opened(port: int) -> ClientConnection:
    """A page's connection."""
    return connect(f"ws://127.0.0.1:{port}/live", compression=None, max_size=None)


def watch(socket: ClientConnection, seconds: float) -> dict[str, Any]:
    """Look for so long: how many pictures and bytes came, and how coarse the last picture was."""
    until_s = time.monotonic() + seconds
    pictures, size, level = 0, 0, ""
    while (left_s := until_s - time.monotonic()) > 0:
        try:
            message = socket.recv(timeout=min(WAIT_S, left_s))
        except TimeoutError:
            continue
        size += len(message)
        if isinstance(message, bytes):
            header = header_of(message)
            socket.send(json.dumps({"do": "seen", "stamp_ns": header["stamp_ns"]}))
            pictures, level = pictures + 1, header["level"]
    return {"pictures": pictures, "bytes": size, "level": level, "seconds": seconds}


def main() -> None:
    """Look, and print what came."""
    port, seconds = int(sys.argv[1]), float(sys.argv[2])
    with opened(port) as socket:
        print("open", flush=True)
        print(json.dumps(watch(socket, seconds)))


if __name__ == "__main__":
    main()
