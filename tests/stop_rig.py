"""Stops by the emergency stop's path, for its tests."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from cocoro.stop.asking import Asking

PATIENCE_S = 60.0


def new_robot() -> str:
    """A robot's name that no other robot on this machine has, since a stop reaches every robot of its name."""
    return f"robot-{os.urandom(4).hex()}"


def stop(robot: str | None, within_s: float = PATIENCE_S) -> Asking:
    """Request a stop and wait for all answers, at most for `within_s`."""
    with Asking(robot) as asking:
        asking.go_on(time.monotonic() + within_s)
        asking.hear_of_the_disk(time.monotonic() + within_s)
    return asking


def stopped_ns(robot: str) -> dict[str, int | None]:
    """Request a stop; returns when each service stopped (CLOCK_MONOTONIC), None for those that did not answer."""
    return {point.service: point.latched_ns for point in stop(robot).points.values()}


@contextmanager
def full_queue(address: str) -> Iterator[None]:
    """Send datagrams to a stop point until its queue is full."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
        with suppress(BlockingIOError):
            while True:
                sender.sendto(b"", b"\0" + address[1:].encode())
        yield
