"""The browser that `bench.lost_control` loses: `python -m bench.lost_control_browser ROBOT FILE`.

A line on standard input is the port of the cockpit: its page is opened in Chromium, takes the robot, turns round and
drives ahead at full speed, with keys that are held down. The time in FILE is that of each message that was sent whose
motion was accepted, by the browser's own times. The next line loses the page: `close`, `crash`, `switch` (another tab
in front), `freeze` (as browsers do with tabs that nobody sees), `let-go`; `again` makes it ready for the next port.
"""

from __future__ import annotations

import json
import select
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.devtools import PUMP_S, Chromium, Tab
from bench.lost_control_driver import PATIENCE_S, SENT, TURN_S
from cocoro.errors import CocoroError

FULL_PACE = "if (location.hostname) localStorage.setItem('cocoro.pace', 'full')"
DRIVES = "document.querySelector('#app[data-driving]')"
TOLD_S = 0.5
"""How often the page is asked why the robot does what it does."""


class Noted:
    """Notes when a motion was sent that was accepted, as the browser tells its messages. Where several were under way
    the first of them counts, so that no time is taken for later than it was."""

    def __init__(self, tab: Tab, file: Path) -> None:
        self._file = file.open("wb", buffering=0)
        self._first_s: float | None = None
        """When the first motion was sent since the last tick came."""
        tab.on("Network.webSocketFrameSent", self._sent)
        tab.on("Network.webSocketFrameReceived", self._received)
        tab.call("Network.enable")

    def _sent(self, told: dict[str, Any]) -> None:
        message = json.loads(told["response"]["payloadData"])
        if message["do"] == "drive" and message["motion"] and self._first_s is None:
            self._first_s = told["timestamp"]
            if not 0.0 <= time.monotonic() - self._first_s < PATIENCE_S:
                raise RuntimeError("the browser's times are not of CLOCK_MONOTONIC")

    def _received(self, told: dict[str, Any]) -> None:
        if told["response"]["opcode"] != 1 or '"kind":"tick"' not in told["response"]["payloadData"]:
            return
        if json.loads(told["response"]["payloadData"])["accepted"] and self._first_s is not None:
            self._file.write(SENT.pack(round(self._first_s * 1e9)))
        self._first_s = None


def drive(browser: Chromium, other: Tab, port: int, file: Path) -> None:
    """Open the page and drive until a line says how to lose it; then lose it, and wait for `again`. `other` is the tab
    that may come to the front."""
    page = browser.tab()
    page.call("Page.enable")
    page.call("Page.addScriptToEvaluateOnNewDocument", source=FULL_PACE)
    Noted(page, file)
    page.call("Page.navigate", url=f"http://127.0.0.1:{port}/")
    take(page)
    page.key("KeyA", down=True)
    browser.pump(TURN_S)
    page.key("KeyW", down=True)
    page.key("KeyA", down=False)
    lose(page, other, line(browser, page))
    line(browser)
    with suppress(CocoroError):  # it may be gone
        page.close()


def take(page: Tab) -> None:
    """Begin to drive. Raises TimeoutError."""
    until_s = time.monotonic() + PATIENCE_S
    page.until("document.querySelector('#link-state[data-state=live]')", PATIENCE_S)
    while time.monotonic() < until_s:
        page.evaluate("document.getElementById('take-over').click()")
        if page.until(DRIVES, 1.0):
            return
        print(page.evaluate("document.getElementById('notices').innerText"), file=sys.stderr)
        page.evaluate("document.querySelector('#notices button')?.click()")  # a busy robot asks again
    raise TimeoutError("the robot is not to be had")


def lose(page: Tab, other: Tab, how: str) -> None:
    """Lose the page."""
    if how == "close":
        page.close()
    elif how == "crash":
        page.tell("Page.crash")  # nobody is left to answer
    elif how == "switch":
        other.to_front()
    elif how == "freeze":
        page.call("Page.setWebLifecycleState", state="frozen")
    else:
        page.key("KeyW", down=False)


def line(browser: Chromium, page: Tab | None = None) -> str:
    """The next line, while events come; tells meanwhile what the page says of driving. Ends the process at the end of
    its input."""
    next_s, told = time.monotonic() + TOLD_S, ""
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        browser.pump(PUMP_S)
        if page is not None and time.monotonic() > next_s:
            next_s += TOLD_S
            if page.evaluate("document.getElementById('drive-state').dataset.state") != "moves":
                page.key("KeyW", down=False)  # on a busy machine the page finds itself frozen, and lets go
                page.key("KeyW", down=True)
            said = page.evaluate(
                "`${document.getElementById('drive-state').innerText} ${document.getElementById('now-why').innerText}`"
            )
            if (word := str(said).partition(" m/s")[2] or str(said)) != told:
                told = word
                print(said, file=sys.stderr, flush=True)
    if text := sys.stdin.readline():
        return text.strip()
    raise SystemExit


def main(file: Path) -> None:
    """Drive once for each port, until the end of the input."""
    with Chromium() as browser:
        other = browser.tab()
        while True:
            drive(browser, other, int(line(browser)), file)


if __name__ == "__main__":
    main(Path(sys.argv[2]))
