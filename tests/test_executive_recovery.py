"""Tasks that go on after a service was lost: the policies, what a task says meanwhile, and how often it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import pytest
from executive_rig import Robot, idle_again, robot
from spelled import action

from cocoro import topics
from cocoro.held_file import HeldFile
from cocoro.keys import asker_key
from cocoro.messages import CancelRequest
from cocoro.messages.actions import ACTIONS, Action
from cocoro.testing import in_virtual_time
from deploy.contact import ProcessContact
from deploy.processes import hardware
from deploy.rundir import RunDir
from services.executive.recovery import Resume, policy, strictest

SERVICES = (*hardware(), "perception", "planning")
PAGE = Path(__file__).parents[1] / "docs/faults.md"


class Processes:
    """The processes of all services of this machine, by their claims."""

    def __init__(self, folder: Path) -> None:
        self.run_dir = RunDir("calliope", folder)
        self._claims: dict[str, list[HeldFile]] = {}
        for service in SERVICES:
            self.start(service)

    def start(self, service: str) -> None:
        self._claims[service] = self.run_dir.claim(service, [service])

    def end(self, service: str) -> None:
        for claim in self._claims.pop(service):
            claim.release()

    def close(self) -> None:
        for service in list(self._claims):
            self.end(service)

    @property
    def contact(self) -> ProcessContact:
        return ProcessContact(self.run_dir.claimant_pid)

    async def kill(self, it: Robot, service: str) -> None:
        self.end(service)
        it.service.other_dies(service)
        await it.service.advance(0.3)

    def restart(self, it: Robot, service: str) -> None:
        self.start(service)
        it.service.others_live(service)


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    it = Processes(tmp_path)
    yield it
    it.close()


class Strangers(Action, frozen=True, tag="strangers"):
    """A third party's."""


WORDS: dict[str, Resume] = {
    "begins anew": "again", "finds the object first": "find", "finds and approaches it first": "approach",
    "if the hand holds something": "holding", "goes on meanwhile": "on", "fails at once": "never",
}  # fmt: skip
FIELDS = {"place_m": (0.0, 0.0), "distance_m": 0.5, "first": 0, "count": 1}


def made(name: str) -> Action:
    return action(name, "red_can", **{k: v for k, v in FIELDS.items() if k in ACTIONS.kind(name).__struct_fields__})


def test_the_page_tells_the_policy_of_every_service_and_action() -> None:
    lines = PAGE.read_text().splitlines()
    head = next(number for number, line in enumerate(lines) if line.startswith("| action | perception"))
    columns = [cell.split(", ") for cell in _cells(lines[head])[1:]]
    assert {service for column in columns for service in column} == set(SERVICES)
    told = set()
    for line in takewhile(lambda line: line.startswith("|"), lines[head + 2 :]):
        names, *rules = _cells(line)
        for name in names.split(", "):
            told.add(name)
            for column, rule in zip(columns, rules, strict=True):
                assert {policy(service, made(name)) for service in column} == {WORDS[rule]}, (name, column)
    assert told == {*ACTIONS.own} - {"idle"}


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_of_several_lost_services_the_strictest_decides_and_of_a_strangers_action_nothing_is_known() -> None:
    place = action("place")
    assert strictest(("perception", "planning"), place) == "holding"
    assert strictest(("perception",), place) == "on"
    assert policy("planning", Strangers()) == "never"
    assert policy("perception", Strangers()) == "again"


@pytest.mark.parametrize("service", SERVICES)
@pytest.mark.parametrize("phase", ["search", "grasp", "lift"])
def test_the_robot_stands_until_the_service_is_back_and_the_task_goes_on(
    service: str, phase: str, processes: Processes
) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {phase: ["never", "done"]}
            await it.begin()
            it.holding = True
            await it.phase(phase)
            await processes.kill(it, service)
            await it.service.advance(9.0)
            assert idle_again(it)
            state = it.state()
            assert (state.outcome, state.phase) == (None, phase)
            assert state.text == f"waiting for {service}, which died; it is back in a moment"
            processes.restart(it, service)
            state = await it.outcome()
            assert (state.outcome, state.reason) == ("done", "")
            assert [each.name for each in state.phases] == ["search", "approach", "reach", "grasp", "lift", "hold"]

    scenario()


def test_an_object_that_was_not_seen_just_now_is_found_again_first(processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"reach": ["never", "done"]}
            await it.begin()
            it.holding = True
            await it.phase("reach")
            await processes.kill(it, "perception")
            processes.restart(it, "perception")
            state = await it.outcome()
            assert (state.outcome, state.reason) == ("done", "")
            assert [each.name for each in state.phases][2:6] == ["reach", "search", "approach", "reach"]

    scenario()


def test_a_task_goes_on_three_times_and_then_fails_and_says_of_what(processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"search": ["never"] * 9}
            await it.begin()
            await it.phase("search")
            for _ in range(3):
                await processes.kill(it, "perception")
                processes.restart(it, "perception")
                await it.service.advance(2.0)
                assert not idle_again(it)
            await processes.kill(it, "perception")
            state = await it.outcome()
            assert (state.outcome, state.reason) == ("failed", "not_alive: perception died, after 3 interruptions")

    scenario()


def test_one_that_dies_again_and_again_before_the_task_goes_on_counts_each_time(processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"search": ["never"] * 9}
            await it.begin()
            await it.phase("search")
            for _ in range(3):
                await processes.kill(it, "planning")
                processes.restart(it, "planning")
                await it.service.advance(0.1)
            await processes.kill(it, "planning")
            assert (await it.outcome()).reason == "not_alive: planning died, after 3 interruptions"

    scenario()


def test_only_what_died_is_called_dead(processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"search": ["never"] * 9}
            await it.begin()
            await it.phase("search")
            it.service.other_dies("perception")  # whose process lives
            await processes.kill(it, "planning")
            processes.restart(it, "planning")
            await it.service.advance(1.0)
            assert it.state().text == "lost contact with perception"
            assert (await it.outcome()).reason == "not_alive: lost contact with perception"

    scenario()


def test_one_that_hangs_and_is_killed_has_the_time_of_a_restart_from_then_on(processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"search": ["never", "done"]}
            await it.begin()
            it.holding = True
            await it.phase("search")
            it.service.other_dies("perception")
            await it.service.advance(9.5)
            processes.end("perception")
            await it.service.advance(5.0)
            processes.restart(it, "perception")
            assert (await it.outcome()).outcome == "done"

    scenario()


@pytest.mark.parametrize("ready_after_s", [25.0, None])
def test_a_new_process_that_is_slow_to_start_has_three_times_as_long(
    ready_after_s: float | None, processes: Processes
) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"search": ["never", "done"]}
            await it.begin()
            it.holding = True
            await it.phase("search")
            await processes.kill(it, "perception")
            path = processes.run_dir.path / "claims" / "perception"
            processes.start("perception")
            path.write_text('{"name": "perception", "pid": 1}')  # another process, which lives
            if ready_after_s is not None:
                await it.service.advance(ready_after_s)
                it.service.others_live("perception")
            state = await it.outcome()
            assert state.reason == ("" if ready_after_s is not None else "not_alive: perception died")
            assert ready_after_s is not None or state.elapsed_s > 30.0

    scenario()


@pytest.mark.parametrize("ended_by", ["cancel", "estop", "time", "asker"])
def test_a_task_that_waits_can_be_ended_and_its_time_runs_on(ended_by: str, processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"search": ["never", "done"]}
            token = it.service.tester.bus.declare_alive(asker_key("calliope", "ann"))
            await it.begin(asker="ann", timeout_s=6.0)
            await it.phase("search")
            await processes.kill(it, "perception")
            if ended_by == "cancel":
                await it.service.ask(topics.CANCEL, CancelRequest())
            elif ended_by == "estop":
                await it.estop(latched=True)
            elif ended_by == "asker":
                token.close()
            state = await it.outcome()
            why = {
                "cancel": "by the operator",
                "estop": "estop: emergency stop by test",
                "time": "timed_out: the task took over 6 s",
            }.get(ended_by, "asker_gone: ")
            assert state.reason.startswith(why)
            assert state.elapsed_s < 6.2
            processes.restart(it, "perception")
            await it.service.advance(5.0)
            assert idle_again(it)

    scenario()


@pytest.mark.parametrize("asker_is_back", [True, False])
def test_an_asker_who_was_cut_off_with_services_must_be_back_with_them(asker_is_back: bool) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:  # nothing is known of any process: they are on other machines
            it.script = {"search": ["never", "done"]}
            token = it.service.tester.bus.declare_alive(asker_key("calliope", "ann"))
            await it.begin(asker="ann")
            it.holding = True
            await it.phase("search")
            token.close()
            await it.service.advance(0.1)
            assert idle_again(it)
            for service in hardware():
                it.service.other_dies(service)
            await it.service.advance(5.0)
            assert (it.state().outcome, it.state().text[:17]) == (None, "lost contact with")
            it.service.others_live(*hardware())
            await it.service.advance(1.0)
            assert idle_again(it), "it waits for the asker"
            if asker_is_back:
                it.service.tester.bus.declare_alive(asker_key("calliope", "ann"))
            state = await it.outcome()
            assert state.outcome == ("done" if asker_is_back else "cancelled")
            assert state.reason[:10] == ("" if asker_is_back else "asker_gone")

    scenario()


def test_what_is_to_be_carried_to_a_place_of_the_last_odometry_is_not(processes: Processes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(contact=processes.contact) as it:
            it.script = {"lift": ["never", "done"]}
            await it.begin(bring=True)
            it.holding = True
            await it.phase("lift")
            await processes.kill(it, "base")
            it.service.tester.publisher(topics.BASE_STATE).incarnation += 1000
            processes.restart(it, "base")
            state = await it.outcome()
            assert state.reason.startswith("not_alive: base was restarted")

    scenario()
