"""What the processes that guard a robot's wheels have in common: their channel to the service that they watch over, and
their own address on the stop path, `ROBOT/wheels` (`cocoro.stop.path`).

A guard imports only the standard library, this project's stop path and what its port needs, so that it starts within
milliseconds. Times are CLOCK_MONOTONIC, which all processes of a machine share.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import signal
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from cocoro.stop.path import Asked, StopPoint

TURN_S = 0.005
"""Longest sleep between two looks at the clock."""
QUIET_NS = 50_000_000
"""A guard reports at least this often."""
PRIORITY = 20
AT_ONCE = 16
"""Most messages, and most stops, that are taken in one turn: a flood of them does not delay the port."""


class GuardProcess(ABC):
    """The service's end of `channel` is a SOCK_SEQPACKET socket; each datagram is a message as JSON."""

    def __init__(self, channel: socket.socket, point: StopPoint | None = None) -> None:
        self._channel = channel
        self._point = point

    @abstractmethod
    def turn(self) -> bool:
        """Handle what has arrived, and write what is due. False when the service is gone."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the wheels for good. It takes as long as that takes."""

    @abstractmethod
    def _stopped(self) -> None:
        """An emergency stop has arrived at the guard's own address."""

    @abstractmethod
    def _obey(self, message: dict[str, Any]) -> None:
        """Obey a message of the service. May raise what a malformed one causes."""

    def _take_stops(self) -> list[Asked]:
        """Receive stop requests."""
        assert self._point is not None
        stops: list[Asked] = []
        while len(stops) < AT_ONCE and (asked := self._point.take(wait=False)) is not None:
            self._stopped()
            stops.append(asked)
        return stops

    def _answer(self, asked: Asked, at_ns: int) -> None:
        """Acknowledge a stop request. A guard keeps no record on disk: its service does."""
        assert self._point is not None
        self._point.latched(asked, at_ns)
        self._point.keeps_nothing(asked)

    def _take_messages(self) -> bool:
        """False when the other end is closed."""
        for _ in range(AT_ONCE):
            try:
                message = self._channel.recv(4096)
            except BlockingIOError:
                return True
            except ConnectionError:
                return False
            if not message:
                return False
            with suppress(ValueError, TypeError, KeyError, AttributeError, OverflowError):  # malformed: ignored
                self._obey(json.loads(message))
        return True

    def _send(self, report: dict[str, Any]) -> None:
        with suppress(BlockingIOError, ConnectionError):
            self._channel.send(json.dumps(report).encode())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port")
    parser.add_argument("--fd", type=int, required=True, help="this process's end of a socket pair")
    parser.add_argument("--robot", help="name of the robot whose emergency stop to obey; none by default")


def run(options: argparse.Namespace, make: Callable[[socket.socket, StopPoint | None], GuardProcess]) -> int:
    """Guard until the service ends, or SIGTERM; the wheels stand when this returns."""
    signals: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the service, which closes the socket
    with suppress(OSError):  # the permission is LimitRTPRIO in the unit file
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    channel = socket.socket(fileno=options.fd)
    channel.setblocking(False)
    fcntl.fcntl(channel, fcntl.F_SETFD, fcntl.FD_CLOEXEC)
    guard = make(channel, StopPoint(options.robot, "wheels") if options.robot else None)
    try:
        while not signals and guard.turn():
            pass
    finally:
        guard.stop()
    return 0
