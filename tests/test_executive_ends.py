"""Ends of a task from outside: an operator, a death, silence, a mistake, a clock that restarts."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from executive_rig import idle_again, robot

from cocoro import topics
from cocoro.clock import NS
from cocoro.held_file import hold
from cocoro.keys import asker_key
from cocoro.messages import CancelRequest, ReportRequest, TaskState
from cocoro.testing import JumpingClock, in_virtual_time
from deploy.contact import ProcessContact, SleepDetector
from deploy.processes import hardware
from deploy.rundir import RunDir
from services.executive.tasks import ParkTask


@in_virtual_time
async def test_a_cancelled_task_says_so_when_the_robot_stands() -> None:
    async with robot() as it:
        it.script, it.speed_mps = {"approach": ["never"]}, 0.3
        task_id = await it.begin()
        await it.phase("approach")
        assert (await it.service.ask(topics.CANCEL, CancelRequest(task_id=task_id))).accepted
        await it.service.advance(1.0)
        assert idle_again(it)
        assert it.state().outcome is None, "it still rolls"
        it.speed_mps = 0.0
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("cancelled", "by the operator")


@in_virtual_time
async def test_only_the_task_that_runs_can_be_cancelled() -> None:
    async with robot() as it:
        assert (await it.service.ask(topics.CANCEL, CancelRequest())).refusal == "no_task"
        it.script = {"search": ["never"]}
        await it.begin()
        assert (await it.service.ask(topics.CANCEL, CancelRequest(task_id="another"))).refusal == "no_task"
        assert (await it.service.ask(topics.CANCEL, CancelRequest())).accepted


@pytest.mark.parametrize("phase", ["search", "approach", "reach", "grasp", "lift", "hold"])
def test_a_task_ends_in_every_phase_when_who_asked_for_it_has_gone(phase: str) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:
            it.script, it.holding = {phase: ["never"]}, False
            token = it.service.tester.bus.declare_alive(asker_key("calliope", "ann"))
            await it.begin(asker="ann")
            it.holding = True
            await it.phase(phase)
            token.close()
            await it.service.settle()
            assert idle_again(it)
            state = await it.outcome()
            assert (state.outcome, state.reason.partition(":")[0]) == ("cancelled", "asker_gone")
            it.holding = False
            await it.service.advance(0.1)
            it.script = {}
            await it.begin("park", "")  # asked by nobody who is watched
            assert (await it.outcome()).outcome == "done"

    scenario()


@in_virtual_time
async def test_an_asker_who_has_gone_before_the_task_begins_gets_none() -> None:
    async with robot() as it:
        reply = await it.ask(asker="ann")
        assert (reply.accepted, reply.refusal) == (False, "asker_gone")
        asking = asyncio.ensure_future(it.ask(asker="ann"))
        await it.service.advance(0.1)
        it.service.tester.bus.declare_alive(asker_key("calliope", "ann"))  # it was slower than the request
        assert (await asking).accepted


@in_virtual_time
async def test_a_task_ends_neither_with_another_asker_nor_after_its_own_end() -> None:
    async with robot() as it:
        it.script = {"search": ["never"]}
        tokens = {name: it.service.tester.bus.declare_alive(asker_key("calliope", name)) for name in ("ann", "bob")}
        await it.begin("park", "", asker="bob")
        assert (await it.outcome()).outcome == "done"
        await it.begin(asker="ann")
        await it.phase("search")
        tokens["bob"].close()
        await it.service.advance(1.0)
        assert it.state().outcome is None
        assert (await it.ask(asker="*")).refusal == "asker_gone"


@in_virtual_time
async def test_the_executive_reports_the_running_task_and_those_that_have_ended() -> None:
    async with robot() as it:

        async def report(task_id: str = "") -> TaskState:
            return await it.service.ask(topics.REPORT, ReportRequest(task_id=task_id))

        assert (await report()).task_id == ""
        first = await it.begin("park", "")
        await it.outcome()
        it.script = {"search": ["never"]}
        second = await it.begin()
        running = await report()
        assert (running.task_id, running.outcome) == (second, None)
        ended = await report(first)
        assert (ended.task_id, ended.outcome) == (first, "done")
        assert (await report("another")).task_id == ""


@pytest.mark.parametrize("ended_by", ["cancel", "estop", "death"])
@pytest.mark.parametrize("when", [*range(1, 9), "in the middle", "coming to rest"])
def test_whatever_ends_a_task_and_whenever_it_ends_once_and_another_can_follow(ended_by: str, when: int | str) -> None:
    """A number is how many turns of the loop after the request."""

    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:
            it.script = {"search": ["lost"] * 9 if when == "coming to rest" else ["never"]}
            it.speed_mps = 0.3
            run = asyncio.ensure_future(it.ask())
            if isinstance(when, str):
                await it.service.advance(1.0)
            else:
                for _ in range(when):
                    await asyncio.sleep(0)
            if ended_by == "cancel":
                await it.service.ask(topics.CANCEL, CancelRequest())
            elif ended_by == "estop":
                await it.estop(latched=True)
            else:
                it.service.other_dies("base")
            accepted = (await run).accepted
            await it.service.advance(10.0)
            states = [state for state in it.service.outputs(topics.TASK) if state.outcome is not None]
            assert len({(state.outcome, state.reason) for state in states}) <= 1
            if isinstance(when, str):
                assert accepted
                assert states[-1].outcome == (
                    "cancelled" if ended_by == "cancel" and when != "coming to rest" else "failed"
                )

            it.service.forget()
            it.script, it.speed_mps, it.holding = {}, 0.0, False
            it.service.others_live("base")
            await it.estop(latched=False)
            await it.service.advance(0.5)
            await it.begin("park", "")
            await it.service.until(lambda: it.state().task == "park" and it.state().outcome == "done")

    scenario()


@pytest.mark.parametrize("service", [*hardware(), "perception", "planning"])
def test_a_task_fails_when_a_service_that_it_needs_is_not_heard_any_more(service: str) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:
            it.script = {"search": ["never"]}
            await it.begin()
            await it.phase("search")
            it.service.other_dies(service)
            state = await it.outcome()
            assert (state.outcome, state.reason) == ("failed", f"not_alive: lost contact with {service}")
            refused = await it.ask()
            assert (refused.refusal, refused.text) == ("not_alive", f"no contact with {service}; see cocoro status")

    scenario()


class Sleepy:
    """A clock of a process that may be stopped."""

    def __init__(self) -> None:
        self.slept_ns = 0

    def __call__(self) -> int:
        return round(asyncio.get_running_loop().time() * NS) + self.slept_ns


@pytest.mark.parametrize(
    ("fate", "reason", "refusal"),
    [
        ("dies", "not_alive: perception died", "not alive: perception; see cocoro status"),
        ("dies a little later", "not_alive: perception died", "not alive: perception; see cocoro status"),
        ("is begun anew", "not_alive: perception died", "not alive: perception; see cocoro status"),
        ("is stopped", "not_alive: lost contact with perception", "no contact with perception; see cocoro status"),
        (
            "is unheard since all slept",
            "not_alive: this machine was asleep or starved for 15 s",
            "no contact with perception; see cocoro status",
        ),
        ("dies while all sleep", "not_alive: perception died", "not alive: perception; see cocoro status"),
    ],
)
def test_only_of_one_that_is_known_to_be_dead_it_is_said_that_it_died(
    fate: str, reason: str, refusal: str, tmp_path: Path
) -> None:
    run_dir = RunDir("calliope", tmp_path)
    claims = run_dir.claim("perception", ["perception"])

    @in_virtual_time
    async def scenario() -> None:
        clock = Sleepy()
        said: list[str] = []
        async with robot(contact=ProcessContact(run_dir.claimant_pid, SleepDetector(said.append, clock))) as it:
            it.script = {"search": ["never"]}
            await it.begin()
            await it.phase("search")
            await it.service.advance(20.0)
            assert said == []
            fault_ns = it.service.tester.now_ns()
            if "all" in fate:
                clock.slept_ns += 15 * NS
            if fate in ("dies", "dies while all sleep", "is begun anew"):
                claims[0].release()
            if fate == "is begun anew":
                path = run_dir.path / "claims" / "perception"
                another = hold(path, "perception")
                assert another is not None
                path.write_text('{"name": "perception", "pid": 1}')
            it.service.other_dies("perception")
            if fate == "dies a little later":
                await it.service.advance(0.3)
                assert idle_again(it), "the robot stands at once"
                assert it.state().outcome is None
                claims[0].release()
            state = await it.outcome()
            assert (state.outcome, state.reason) == ("failed", reason)
            waited_s = (state.stamp_ns - fault_ns) / NS
            longest_s = 30.0 if fate == "is begun anew" else 10.0  # while another process starts
            assert longest_s <= waited_s < longest_s + 0.7
            assert (await it.ask()).text == refusal
            await it.service.advance(20.0)
            assert said == (["this machine was asleep or starved for 15 s"] if "all" in fate else [])

    scenario()


@in_virtual_time
async def test_a_planner_that_was_only_late_ends_no_task() -> None:
    async with robot() as it:
        await it.begin()
        await it.phase("search")
        it.silent = True
        await it.service.advance(9.0)
        it.silent, it.holding = False, True
        assert (await it.outcome()).outcome == "done"
        assert "waiting" not in it.state().text


def test_with_a_service_that_lives_the_task_waits_for_contact_and_the_robot_stands(tmp_path: Path) -> None:
    run_dir = RunDir("calliope", tmp_path)
    claims = run_dir.claim("perception", ["perception"])

    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=ProcessContact(run_dir.claimant_pid)) as it:
            it.script = {"search": ["never", "done"]}
            await it.begin()
            await it.phase("search")
            it.service.other_dies("perception")
            await it.service.advance(9.0)
            assert idle_again(it)
            assert (it.state().outcome, it.state().text) == (None, "lost contact with perception")
            it.service.others_live("perception")
            it.holding = True
            assert (await it.outcome()).outcome == "done"

    scenario()
    for claim in claims:
        claim.release()


@in_virtual_time
async def test_a_planner_that_lives_but_says_nothing_is_waited_for_and_in_the_end_fails_the_task() -> None:
    async with robot() as it:
        it.script = {"search": ["never"]}
        await it.begin()
        await it.phase("search")
        it.silent = True
        silent_s = it.service.tester.now_ns() / NS
        await it.service.advance(5.0)
        assert (it.state().outcome, it.state().text) == (None, "waiting: nothing from the planner for 4.8 s")
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "not_alive: nothing from the planner for 10 s")
        assert state.stamp_ns / NS - silent_s < 12.0
        assert (await it.ask()).refusal == "not_alive"


@in_virtual_time
async def test_a_mistake_in_a_task_is_told_and_is_not_the_end_of_the_executive(monkeypatch: pytest.MonkeyPatch) -> None:
    async def broken(*_: object) -> None:
        raise ZeroDivisionError("a mistake")

    monkeypatch.setattr(ParkTask, "run", broken)
    async with robot() as it:
        await it.begin("park", "")
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "internal error: a mistake")
        it.service.forget()
        await it.begin("fetch", "red_can", timeout_s=1.0)
        assert (await it.outcome()).reason.startswith("timed_out")


@in_virtual_time
async def test_when_the_clock_begins_anew_the_task_ends_and_the_next_one_can_begin() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with robot(clock) as it:
        it.script = {"search": ["never"]}
        await it.begin()
        await it.phase("search")
        clock.jump_to(1.0)
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "clock: the clock began anew")
        assert state.elapsed_s >= 0.0
        it.service.forget()
        await it.service.advance(0.5)
        await it.begin("park", "")
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("done", "")
