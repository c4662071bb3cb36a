"""The page that `bench.lost_control` loses: `python -m bench.lost_control_page ROBOT FILE`.

Drives as `bench.lost_control_driver` does, over the cockpit's WebSocket, whose port is the first line of its standard
input: takes the robot, turns round, and drives ahead at full speed. The time in FILE is that of each message that was
sent whose motion was accepted. A line `freeze` is a page that sends nothing any more and keeps its socket, `let-go`
asks for rest.
"""

from __future__ import annotations

import itertools
import json
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection

from bench.cockpit_viewer import opened
from bench.lost_control_driver import PATIENCE_S, SENT, TURN_S

TURN = {"turn_radps": 1.5}
FAST = {"speed_mps": 1.0}
PERIOD_S = 0.04


class DrivingPage:
    """A page whose control is held."""

    def __init__(self, socket: ClientConnection, file: Path) -> None:
        self._socket = socket
        self._file = file.open("ab", buffering=0)
        self._tick = 0
        self._ids = itertools.count(1)  # one request at a time, so the next answer is its own

    def say(self, do: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"do": do, **fields}))

    def begin(self) -> None:
        """Take the robot. Raises TimeoutError."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            self.say("begin-drive", id=next(self._ids), instead=True)
            reply = self._until(lambda message: message["kind"] == "reply")
            if reply["ok"]:
                return
            print(reply["text"], file=sys.stderr)
            time.sleep(0.2)
        raise TimeoutError("the robot is not to be had")

    def move(self, motion: dict[str, float]) -> None:
        """Send a motion, and hear whether it counts."""
        sent_ns = time.monotonic_ns()
        self.say("drive", tick=self._tick, motion=motion)
        told = self._until(lambda message: message["kind"] == "tick")
        self._tick = told["tick"]
        if told["accepted"] and motion:
            self._file.write(SENT.pack(sent_ns))

    def _until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        while True:
            text = self._socket.recv(timeout=PATIENCE_S)
            message: dict[str, Any] = {} if isinstance(text, bytes) else json.loads(text)
            if message and wanted(message):
                return message


def main() -> None:
    """Drive from the first line on until the next one says what else to do, and for ever then."""
    with opened(int(sys.stdin.readline())) as socket:
        page = DrivingPage(socket, Path(sys.argv[2]))
        page.say("pictures", on=False)
        page.begin()
        begun_s = time.monotonic()
        while not select.select([sys.stdin], [], [], 0.0)[0]:
            page.move(TURN if time.monotonic() - begun_s < TURN_S else FAST)
            time.sleep(PERIOD_S)
        if sys.stdin.readline().strip() != "freeze":
            page.move({})
        time.sleep(3600.0)


if __name__ == "__main__":
    main()
