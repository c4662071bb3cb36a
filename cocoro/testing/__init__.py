"""Tests of components without a robot, in virtual time: feed a component, let time pass, read its outputs.

    @in_virtual_time
    async def test_it_answers_what_it_hears() -> None:
        async with ServiceUnderTest(component, {"loudness": 2.0}) as service:
            service.feed(BASE_STATE, BaseState(...))
            await service.advance(0.1)
            assert service.latest(ECHO).volume == 2.0

The service runs as on a robot, on a bus of one process: every message is encoded, checked and decoded. `misdeclared`
compares what it did with its declaration. `CoreUnderTest` steps a pure core by hand. `execute_again` shows that a core
depends on nothing but its recorded inputs.
"""

from cocoro.testing.core import CoreUnderTest, Executed, execute_again
from cocoro.testing.mesh import NotedBus, Tap, misdeclared
from cocoro.testing.service import ServiceUnderTest
from cocoro.testing.virtual import JumpingClock, in_virtual_time, settle

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
