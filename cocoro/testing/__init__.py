"""Tests of components, without a robot and without waiting: feed one, let virtual time pass, read what it says.

    @in_virtual_time
    async def test_it_answers_what_it_hears() -> None:
        async with ServiceUnderTest("echo.service", {"loudness": 2.0}) as service:
            service.feed(BASE_STATE, BaseState(...))
            await service.advance(0.1)
            assert service.latest(ECHO).volume == 2.0

The service runs as it would on a robot, on a bus of one process: every message is encoded, checked and decoded on
its way. `CoreUnderTest` steps a pure core by hand, and `execute_again` shows that a core depends on nothing but what
was recorded of it.
"""

from cocoro.testing.again import Executed, execute_again
from cocoro.testing.clock import JumpingClock
from cocoro.testing.core import CoreUnderTest
from cocoro.testing.declared import NotedBus, misdeclared
from cocoro.testing.service import ServiceUnderTest
from cocoro.testing.tap import Tap
from cocoro.testing.virtual import in_virtual_time, settle

__all__ = [
    "CoreUnderTest",
    "Executed",
    "JumpingClock",
    "NotedBus",
    "ServiceUnderTest",
    "Tap",
    "execute_again",
    "in_virtual_time",
    "misdeclared",
    "settle",
]
