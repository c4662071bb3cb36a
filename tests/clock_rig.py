"""A set-up for tests of clocks: the system's clocks follow the time of the virtual loop.

`pytest_plugins` in conftest.py registers the fixture.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

import cocoro.clock
from cocoro.clock import NS


@pytest.fixture
def real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the system's clocks follow the virtual loop's time, from 100 s on."""

    class Time:
        CLOCK_BOOTTIME = "boottime"
        wall_ns = 1_000_000 * NS

        @classmethod
        def clock_gettime_ns(cls, which: object) -> int:
            assert which == cls.CLOCK_BOOTTIME, "the only clock that decides"
            return 100 * NS + round(asyncio.get_running_loop().time() * NS)

        @classmethod
        def time_ns(cls) -> int:
            return cls.wall_ns + round(asyncio.get_running_loop().time() * NS)

    monkeypatch.setattr(cocoro.clock, "time", Time)


def step_wall_clock(seconds: float) -> None:
    cocoro.clock.time.wall_ns += round(seconds * NS)  # type: ignore[attr-defined]


def loop_s() -> float:
    return asyncio.get_running_loop().time()


async def started(waiting: Coroutine[Any, Any, bool]) -> asyncio.Task[bool]:
    """Start a task and run it until its first wait."""
    task = asyncio.create_task(waiting)
    for _ in range(5):
        await asyncio.sleep(0)
    return task
