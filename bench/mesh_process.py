"""One of the two processes of a way to send messages, as `bench.mesh` measures it.

    python -m bench.mesh_process WAY ROLE FOLDER

Role `b` receives, and answers each message when it is told to `echo`; role `a` sends and keeps count of the answers;
role `daemon` is for dora, whose daemon starts the two others. Each of the two is told what to do by lines of JSON on a
socket in the folder. Every message begins with the time at which its sending began; the time on the way ends where a
program would begin to work on the message.
"""

from __future__ import annotations

import importlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, Literal

from cocoro.clock import steady_ns

SMALL_BYTES = 1024
FRAME_BYTES = 640 * 480 * 5
STAMP_BYTES = 8
QUIET_S = 0.5
"""What has not come when nothing came for this long is lost."""
SOCKET = "control"
Role = Literal["a", "b"]
WAYS = {
    "Node to Node": "bench.mesh_ours:NodeWay",
    "raw zenoh": "bench.mesh_ours:RawWay",
    "raw zenoh, asyncio": "bench.mesh_ours:RawLoopWay",
    "pyzmq": "bench.mesh_peers:ZmqWay",
    "iceoryx2": "bench.mesh_peers:IceoryxWay",
    "eCAL": "bench.mesh_peers:EcalWay",
    "dora": "bench.mesh_peers:DoraWay",
}
"""Where the class of each way is, by its name in the report."""


def stamp(data: bytes | memoryview) -> int:
    """The time at which the sending of raw bytes began, ns of `steady_ns`."""
    return int.from_bytes(data[:STAMP_BYTES], "little")


class Tally:
    """The times on the way of what one process received, and what it does with each message."""

    def __init__(self, send: Callable[[], None]) -> None:
        self.took_ns: list[int] = []
        self.echo = False
        self._send = send
        self._left = 0
        self._complete = threading.Event()

    def begin(self, expected: int, echo: bool) -> None:
        """Forget what came, and expect this number of messages."""
        self.took_ns, self.echo, self._left = [], echo, expected
        self._complete.clear()

    def arrived(self, took_ns: int) -> None:
        """A small message or a frame has arrived."""
        self.took_ns.append(took_ns)
        self._left -= 1
        if self.echo and (self._left > 0 or self.echoes_last):
            self._send()
        if self._left == 0:
            self._complete.set()

    echoes_last = True
    """Whether the last message is answered, too: by `b`, but not by `a`, which began."""

    def wait(self) -> list[int]:
        """What arrived, once all is there, or nothing has come for `QUIET_S`."""
        before = -1
        while not self._complete.wait(QUIET_S) and len(self.took_ns) > before:
            before = len(self.took_ns)
        return self.took_ns


class Way:
    """A way to send, in one of its two processes. Subclasses that call back on arrival implement `open`, `send_small`,
    `send_frame` and `close`; those whose program waits for messages override `receive_forever` and `bounce`, too."""

    receives_in_main: ClassVar[bool] = False
    """Whether `receive_forever` must run in the main thread of `b`."""

    def __init__(self, folder: Path, role: Role) -> None:
        self.folder = folder
        self.role = role
        self.other: Role = "b" if role == "a" else "a"
        self.tally = Tally(self.send_small)
        self.tally.echoes_last = role == "b"

    def open(self) -> None:
        raise NotImplementedError

    def send_small(self) -> None:
        raise NotImplementedError

    def send_frame(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def receive_forever(self) -> None:
        """Hand all that arrives to the tally; nothing to do where the library calls back."""

    def bounce(self, count: int) -> list[int]:
        """Send, and send again when the answer has come, `count` times. Returns the answers' times on the way, ns."""
        self.tally.begin(count, echo=True)
        self.send_small()
        return self.tally.wait()

    def paced(self, count: int, hz: float, send: Callable[[], None]) -> None:
        """Send at a rate."""
        begin_s = time.monotonic()
        for number in range(count):
            time.sleep(max(0.0, begin_s + number / hz - time.monotonic()))
            send()

    def told(self, order: dict[str, Any]) -> object:
        """Carry out one order; returns the answer."""
        what, count = order["do"], order.get("count", 0)
        if what == "expect":
            self.tally.begin(count, echo=order["echo"])
        elif what == "arrived":
            return self.tally.wait()
        elif what == "bounce":
            return self.bounce(count)
        elif what == "send":
            self.paced(count, order["hz"], self.send_frame if order["frames"] else self.send_small)
        return None

    def run(self) -> None:
        """Carry out orders until the socket closes."""
        self.open()
        orders = control(self.folder, self.role)
        if self.role == "b" and self.receives_in_main:
            threading.Thread(target=self._obey, args=(orders,), daemon=True).start()
            self.receive_forever()
        else:
            if self.role == "b":
                threading.Thread(target=self.receive_forever, daemon=True).start()
            self._obey(orders)

    def _obey(self, orders: Iterator[tuple[dict[str, Any], Callable[[object], None]]]) -> None:
        for order, answer in orders:
            answer(self.told(order))
        self.close()
        os._exit(0)  # threads that wait for messages do not end otherwise


def control(folder: Path, role: Role) -> Iterator[tuple[dict[str, Any], Callable[[object], None]]]:
    """Connects to the conductor; yields each order with the function that answers it."""
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(str(folder / SOCKET))
        file = line.makefile("rw")

        def answer(value: object) -> None:
            file.write(json.dumps(value) + "\n")
            file.flush()

        answer({"role": role})
        for text in file:
            yield json.loads(text), answer


def stamped(data: bytes) -> bytes:
    """The data with the present time in front."""
    return steady_ns().to_bytes(STAMP_BYTES, "little") + data


def main() -> None:
    name, role, folder = sys.argv[1:]
    module, _, kind = WAYS[name].partition(":")
    if role == "daemon":
        importlib.import_module(module).start_dora(Path(folder))
        return
    way: Way = getattr(importlib.import_module(module), kind)(Path(folder), role)
    way.run()


if __name__ == "__main__":
    main()
