"""The emergency stop's word in the executive: whom it believes, and what a latched stop does to a task."""

from __future__ import annotations

from executive_rig import idle_again, robot

from cocoro import topics
from cocoro.testing import ServiceUnderTest, in_virtual_time
from deploy.processes import stoppable


@in_virtual_time
async def test_it_knows_no_latch_until_it_has_heard_of_one() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await service.advance(30.0)
        assert {latch.state for latch in service.outputs(topics.LATCH)} == {"unknown"}


@in_virtual_time
async def test_when_nobody_knows_the_latch_nobody_ever_latched_it() -> None:
    async with robot(ready=False) as it:
        it.says = dict.fromkeys(stoppable(), "unknown")
        await it.service.advance(0.4)
        assert it.latch() == "unknown"
        await it.service.advance(0.4)
        assert it.latch() == "released"


@in_virtual_time
async def test_a_robot_is_up_when_the_latch_is_known_or_has_not_become_known_for_long() -> None:
    async with robot(ready=False) as it:
        it.says = {}
        await it.service.advance(1.0)
        assert not it.service.alive
        it.says = dict.fromkeys(stoppable(), "released")
        await it.service.advance(0.1)
        assert (it.service.alive, it.latch()) == (True, "released")
    async with robot(ready=False) as it:
        it.says = {"base": "released"}
        await it.service.advance(5.1)
        assert (it.service.alive, it.latch()) == (True, "unknown")
        refused = await it.ask()
        assert refused.refusal == "estop"
        assert "arm, hand did not report it" in refused.text


@in_virtual_time
async def test_while_one_has_not_been_heard_the_others_not_knowing_says_nothing() -> None:
    async with robot(ready=False) as it:
        it.says = {"base": "unknown", "arm": "unknown"}
        await it.service.advance(10.0)
        assert it.latch() == "unknown"


@in_virtual_time
async def test_a_restarted_executive_believes_whoever_is_latched() -> None:
    async with robot(ready=False) as it:
        it.says = {"base": "unknown", "arm": "latched", "hand": "unknown"}
        await it.service.advance(0.2)
        assert it.latch() == "latched"


@in_virtual_time
async def test_a_restarted_executive_goes_on_where_all_of_the_hardware_does() -> None:
    async with robot(ready=False) as it:
        it.says = {"base": "released", "arm": "unknown"}
        await it.service.advance(10.0)
        assert it.latch() == "unknown", "the hand may have been told to stop meanwhile"
        it.says = {"base": "released", "arm": "unknown", "hand": "released"}
        await it.service.advance(0.2)
        assert it.latch() == "released"


@in_virtual_time
async def test_latched_hardware_latches_everything_and_a_reset_is_not_undone_by_what_was_said_before_it() -> None:
    async with robot() as it:
        it.says["base"] = "latched"
        await it.service.advance(0.1)
        assert it.latch() == "latched"
        assert (await it.ask()).refusal == "estop"
        assert (await it.estop(latched=False)).latch == "released"
        await it.service.advance(0.3)
        assert it.latch() == "released"
        await it.service.advance(0.3)
        assert it.latch() == "latched", "the base is latched to this moment"


@in_virtual_time
async def test_a_latched_stop_ends_the_task_at_once_and_is_told_at_once() -> None:
    async with robot() as it:
        it.script = {"search": ["never"]}
        await it.begin()
        await it.phase("search")
        it.service.forget()
        await it.estop(latched=True)
        await it.service.settle()
        assert it.latch() == "latched"
        assert idle_again(it)
        assert (await it.outcome()).reason == "estop: emergency stop by test"
