"""Chromium by its DevTools protocol alone: tabs that lie in front of and behind one another as those of a person do.

Playwright gives every tab the focus, so none is ever hidden; a bench of what happens to a hidden page cannot use it.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any, Self

from websockets.sync.client import connect

from bench.browser import CHROMIUM, FLAGS
from cocoro.errors import CocoroError, ConfigError

PATIENCE_S = 30.0
PUMP_S = 0.02
Listener = Callable[[dict[str, Any]], None]


class Chromium:
    """A browser with a profile of its own, as a context manager. Not for several threads."""

    def __enter__(self) -> Self:
        program = shutil.which(CHROMIUM)
        if program is None:
            raise ConfigError(f"there is no {CHROMIUM}: on Debian `apt-get install chromium` brings it")
        self._ending = ExitStack()
        profile = tempfile.mkdtemp(prefix="chromium")
        self._ending.callback(shutil.rmtree, profile, ignore_errors=True)
        argv = [program, *FLAGS, "--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank"]
        self._process = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True)
        self._ids = itertools.count(1)
        self._listeners: dict[tuple[str, str], Listener] = {}
        try:
            self._socket = self._ending.enter_context(connect(self._address(), max_size=None))
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._ending.close()

    def _address(self) -> str:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if found := re.search(r"DevTools listening on (ws://\S+)", line):
                return found[1]
        raise CocoroError(f"{CHROMIUM} does not start")

    def tab(self) -> Tab:
        """A new empty tab, in front of the others."""
        target = self.call("", "Target.createTarget", url="about:blank")["targetId"]
        return Tab(self, target, self.call("", "Target.attachToTarget", targetId=target, flatten=True)["sessionId"])

    def listen(self, session: str, event: str, listener: Listener) -> None:
        self._listeners[session, event] = listener

    def tell(self, session: str, method: str, **params: Any) -> int:
        """Send a command without waiting for its answer; returns its number."""
        number = next(self._ids)
        message = {"id": number, "method": method, "params": params}
        self._socket.send(json.dumps(message | ({"sessionId": session} if session else {})))
        return number

    def call(self, session: str, method: str, **params: Any) -> dict[str, Any]:
        """Send a command; returns its result. Raises CocoroError when it fails, or nothing comes."""
        number, until_s = self.tell(session, method, **params), time.monotonic() + PATIENCE_S
        while (left_s := until_s - time.monotonic()) > 0:
            message = self._next(left_s)
            if message.get("id") == number:
                if "error" in message:
                    raise CocoroError(f"{method}: {message['error']['message']}")
                return dict(message["result"])
        raise CocoroError(f"{method}: the browser does not answer")

    def pump(self, seconds: float) -> None:
        """Let events come for so long."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            self._next(left_s)

    def _next(self, wait_s: float) -> dict[str, Any]:
        """The next message, after its listener was called; empty when none comes in time."""
        message: dict[str, Any] = {}
        with suppress(TimeoutError):
            message = json.loads(self._socket.recv(timeout=wait_s))
        listener = self._listeners.get((message.get("sessionId", ""), message.get("method", "")))
        if listener is not None:
            listener(message["params"])
        return message


class Tab:
    """A tab of the browser."""

    def __init__(self, browser: Chromium, target: str, session: str) -> None:
        self._browser, self._target, self._session = browser, target, session

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """As `Chromium.call`."""
        return self._browser.call(self._session, method, **params)

    def tell(self, method: str, **params: Any) -> None:
        """As `Chromium.tell`."""
        self._browser.tell(self._session, method, **params)

    def on(self, event: str, listener: Listener) -> None:
        """Call `listener` with each event of that name."""
        self._browser.listen(self._session, event, listener)

    def to_front(self) -> None:
        self._browser.call("", "Target.activateTarget", targetId=self._target)

    def close(self) -> None:
        """Close it, as a person does."""
        self._browser.call("", "Target.closeTarget", targetId=self._target)

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of the page."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def until(self, condition: str, patience_s: float = PATIENCE_S) -> bool:
        """Wait until an expression of the page is true; returns whether it is so in time."""
        until_s = time.monotonic() + patience_s
        while not self.evaluate(f"Boolean({condition})"):
            if time.monotonic() > until_s:
                return False
            self._browser.pump(PUMP_S)
        return True

    def key(self, code: str, *, down: bool) -> None:
        """Press a letter's key, such as `KeyW`, or release it."""
        letter = code[-1]
        self.call(
            "Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code, key=letter.lower(),
            windowsVirtualKeyCode=ord(letter),
        )  # fmt: skip
