"""A service's end of the guard of its wheels: starts the guard's process, talks to it, and replaces it when it dies or
hangs (`cocoro.guard_process` is the other end)."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

from cocoro.child import ChildProcess, wait_or_kill

log = logging.getLogger("cocoro.base")

LATE_S, HANGS_S = 0.12, 0.25
"""A guard reports at least 20 times a second. When a report is later than the first time (or, at high wheel speeds,
than a shorter one), its service stops the wheels itself; a guard that was only slow undoes that with its next command.
A guard that is silent for the second time hangs, and is killed."""
START_S = 5.0
"""Time in which a new guard must report first, on a busy machine. Until then it has turned no wheels."""
AGAIN_S = 1.0
"""A guard that dies sooner than this after its start is not replaced before this time is over."""
END_S = 2.0


class GuardKeeper(ABC):
    """Use it as an asynchronous context manager."""

    def __init__(self) -> None:
        self.starts = 0
        self._guard: ChildProcess | None = None
        self._ended = False
        self._started_s = 0.0
        self._reported_s = 0.0
        self._late = False
        self._late_s = LATE_S

    @abstractmethod
    def _child(self) -> ChildProcess:
        """Start a guard."""

    @abstractmethod
    def _heard(self, message: bytes) -> None:
        """The guard has sent a report. Called in the event loop."""

    @abstractmethod
    def _halt(self, *, for_good: bool) -> None:
        """Stop the wheels, which nobody guards now: `for_good` when the guard is lost, else it is only late."""

    @abstractmethod
    def _lost(self, why: str) -> None:
        """The guard died or hangs, and another one is started next."""

    async def __aenter__(self) -> Self:
        self._start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended = True
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.close()  # the guard then stops the wheels and ends
            await asyncio.get_running_loop().run_in_executor(None, wait_or_kill, guard.process, END_S)

    @property
    def pid(self) -> int | None:
        return None if self._guard is None else self._guard.process.pid

    def check(self) -> None:
        """Replace a guard that has died or hangs. Must be called every few heartbeats."""
        now_s = time.monotonic()
        if self._guard is not None:
            self._guard.read()  # a report that waits to be read is no silence
        if self._ended:
            return
        if self._guard is None:
            if now_s - self._started_s > AGAIN_S or self.starts < 2:
                self._start()
            return
        silent_s = now_s - (self._reported_s or self._started_s + START_S)
        if silent_s > HANGS_S:
            self._replace("the guard of the port hangs")
        elif silent_s > self._late_s and not self._late:
            self._late = True
            self._halt(for_good=False)

    def _start(self) -> None:
        self._guard = self._child()
        self._started_s = time.monotonic()
        self._reported_s = 0.0
        self._late = False
        self.starts += 1
        self._guard.watch(self._take_report, lambda: self._replace("the guard of the port died"))

    def _take_report(self, message: bytes) -> None:
        self._reported_s = time.monotonic()
        self._late = False
        self._heard(message)

    def _replace(self, why: str) -> None:
        """Stop the wheels, which nobody guards any more, then start another guard."""
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.close()
        self._halt(for_good=True)  # first of all: this process may be killed between any two of these lines
        if guard is not None:
            guard.process.kill()
            asyncio.get_running_loop().run_in_executor(None, guard.process.wait)
        self._halt(for_good=True)
        log.error("%s; the wheels were stopped, and another guard is started", why)
        self._lost(why)
        self.check()

    def _send(self, message: dict[str, Any]) -> None:
        """From any thread."""
        if (guard := self._guard) is not None:
            guard.send(json.dumps(message).encode())  # a guard that is dead is noticed by its silence


def write(port: str, command: bytes) -> None:
    """Write to a port although another process has it open; its settings are still in force."""
    with suppress(OSError):
        fd = os.open(port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            os.write(fd, command)
        finally:
            os.close(fd)
