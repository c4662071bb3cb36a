"""Processes of a robot that runs are killed and stopped while it drives; the simulator's truth says what became of it.

Policies: docs/faults.md.
"""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest
from faults_live import SERVICES, SHORT_LEASE, LiveRobot, live
from spelled import asked

from cocoro import topics
from deploy.heartbeat import GRACE
from deploy.processes import hardware

pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]

ZERO_S = 0.22
"""Bound from the fault until only zero is commanded."""
STAND_S = 0.3
"""Bound from the fault until the body stands, by the true state."""
FAR = """
[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [2.2, -0.1]
"""


@pytest.fixture
def far(tmp_path: Path) -> Path:
    """A can so far off that one can stop on the way to it more than once."""
    scene = tmp_path / "far.toml"
    scene.write_text(FAR)
    return scene


async def fault(robot: LiveRobot, service: str, number: signal.Signals) -> float:
    """Send a signal and give the time, of the simulator, by which the process had it."""
    robot.signal(service, number)
    return await robot.surely_now_s()


async def stands_in_time(robot: LiveRobot, fault_s: float, for_s: float = 0.9) -> None:
    await robot.until(lambda: robot.now_s > fault_s + for_s)
    assert robot.stood_since(fault_s + STAND_S), robot.speeds(fault_s)
    assert not robot.obeyed_since(fault_s + ZERO_S)


@pytest.mark.parametrize("service", ["planning", "perception", "executive"])
def test_who_is_stopped_or_killed_while_driving_leaves_a_robot_that_stands(
    service: str, tmp_path: Path, far: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(GRACE, "60")  # so that who is stopped is not killed before it goes on

    async def scenario() -> None:
        async with live(tmp_path, scene=far) as robot:
            task_id = await robot.driving()
            stopped_s = await fault(robot, service, signal.SIGSTOP)
            await stands_in_time(robot, stopped_s)
            robot.signal(service, signal.SIGCONT)
            await robot.drives(task_id=task_id)

            first = robot.pid(service)
            killed_s = await fault(robot, service, signal.SIGKILL)
            await stands_in_time(robot, killed_s)
            await robot.told(f"{service} was killed by SIGKILL; restart in")
            await robot.told(f"{service} ready in")
            assert robot.pid(service) != first
            if service == "executive":
                assert robot.stood_since(killed_s + STAND_S), "its task is lost; who comes back waits to be asked"
                await robot.driving()
            else:
                await robot.drives(task_id=task_id)
                said = {state.text for state in robot.heard(topics.TASK)}
                assert f"waiting for {service}, which died; it is back in a moment" in said

    asyncio.run(scenario())


def test_a_fetch_ends_well_though_perception_and_planning_die_and_its_grip_holds_through_an_emergency_stop(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with live(tmp_path, pace=1.0) as robot:
            await fetches_while_they_die(robot)
            code, said = await robot.command("estop")
            assert code == 0, said
            code, said = await robot.command("put-down")
            assert code == 3, said
            assert "emergency stop is latched" in said
            await robot.passes(2.0)
            assert robot.held("red_can")
            code, said = await robot.command("reset")
            assert code == 0, said
            await robot.passes(0.5)
            assert robot.held("red_can")
            code, said = await robot.command("put-down")
            assert code == 0, said
            await robot.passes(0.5)
            can = next(item for item in robot.heard(topics.TRUTH)[-1].objects if item.label == "red_can")
            assert can.touching == ("floor",)
            assert can.position_m[2] == pytest.approx(0.06, abs=0.003), "it stands"

    asyncio.run(scenario())


async def fetches_while_they_die(robot: LiveRobot) -> None:
    task_id = await robot.begin(asked("fetch", label="red_can"))
    for service, phase in (("perception", "approach"), ("planning", "lift")):
        await robot.until(lambda phase=phase: (state := robot.state(task_id)) and state.phase == phase)  # type: ignore[misc]
        robot.signal(service, signal.SIGKILL)
        await robot.told(f"{service} was killed by SIGKILL; restart in")
    state = await robot.outcome(task_id)
    assert (state.outcome, state.reason) == ("done", "")
    assert robot.held("red_can")


def test_who_hangs_is_killed_and_the_task_goes_on_with_its_successor(
    tmp_path: Path, far: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(GRACE, "3")

    async def scenario() -> None:
        async with live(tmp_path, scene=far, mesh=SHORT_LEASE) as robot:
            task_id = await robot.driving()
            stopped_s = await fault(robot, "perception", signal.SIGSTOP)
            await stands_in_time(robot, stopped_s)
            await robot.told("perception hangs: ")
            await robot.told("perception ready in")
            await robot.drives(task_id=task_id)

    asyncio.run(scenario())


def test_who_is_stopped_for_longer_than_the_lease_ends_the_task_and_is_back_when_it_goes_on(
    tmp_path: Path, far: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(GRACE, "0")

    async def scenario() -> None:
        async with live(tmp_path, scene=far, mesh=SHORT_LEASE) as robot:
            task_id = await robot.driving()
            pid = robot.pid("perception")
            stopped_s = await fault(robot, "perception", signal.SIGSTOP)
            state = await robot.outcome(task_id)
            # The planner ends what needs sight, or the executive all that it lacks a service for.
            assert state.outcome == "failed"
            assert state.reason.startswith(
                ("stale: standing still: nothing from perception", "not_alive: lost contact")
            )
            await stands_in_time(robot, stopped_s)
            await robot.told("lost contact with perception: no sign of it")
            code, said = await robot.command("status")
            assert code == 1
            assert "no contact" in next(line for line in said.splitlines() if line.startswith("perception "))
            assert (await robot.ask(asked("park"))).refusal == "not_alive"
            robot.signal("perception", signal.SIGCONT)
            await robot.told("perception is back")
            assert robot.pid("perception") == pid, "who is stopped is not killed, with this grace"
            await robot.passes(1.0)  # until it has told what it sees: a task is not begun blindly
            await robot.driving()

    asyncio.run(scenario())


def test_bad_messages_on_every_key_of_a_robot_that_drives_are_counted_and_stop_nothing(
    tmp_path: Path, far: Path
) -> None:
    rubbish = (b"", b"\xc1", b"what is this", b"\x81\xa3seq\xa3one", bytes(300_000))

    async def scenario() -> None:
        async with live(tmp_path, scene=far) as robot:
            task_id = await robot.driving()
            pids = {service: robot.pid(service) for service in SERVICES}
            for topic in topics.TOPICS:
                for service in SERVICES if "{" in topic.name else ("",):
                    for payload in rubbish:
                        robot.publish(topic.name.format(service=service), payload)
            began_s = await robot.surely_now_s()
            await robot.drives(task_id=task_id)

            def counted() -> bool:
                """Whether every service reports them in a later health message."""
                return all(
                    any(
                        health.stamp_ns > began_s * 1e9 and sum(port.rejected for port in health.topics) >= len(rubbish)
                        for health in robot.heard(topics.HEALTH.of(service))
                    )
                    for service in SERVICES
                    if service != "kinect"  # which reads nothing
                )

            await robot.until(counted)
            assert {service: robot.pid(service) for service in SERVICES} == pids

    asyncio.run(scenario())


def test_a_simulator_that_is_killed_comes_back_and_all_others_work_with_it_as_before(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with live(tmp_path, pace=1.0) as robot:
            task_id = await robot.driving()
            others = {service: robot.pid(service) for service in ("perception", "planning", "executive")}
            robot.signal("base", signal.SIGKILL)
            await robot.told("sim was killed by SIGKILL; restart in")
            state = await robot.outcome(task_id)
            assert state.outcome == "failed"
            assert state.reason in {f"not_alive: {part} died" for part in hardware()}
            await robot.told("sim (kinect, base, arm, hand) ready in")
            robot.forget()
            code, said = await robot.command("fetch", "red_can")
            assert code == 0, said
            assert robot.held("red_can")
            assert {service: robot.pid(service) for service in others} == others

    asyncio.run(scenario())


def test_a_simulator_that_is_stopped_stops_time_and_when_it_goes_on_so_does_the_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(GRACE, "60")

    async def scenario() -> None:
        async with live(tmp_path) as robot:
            task_id = await robot.driving()
            robot.signal("base", signal.SIGSTOP)
            # No event marks that time stands; wait longer than any silence of a running robot.
            await asyncio.sleep(1.0)
            robot.signal("base", signal.SIGCONT)
            await robot.drives(task_id=task_id)

    asyncio.run(scenario())


def test_a_robot_whose_battery_is_low_says_so_and_takes_no_task(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with live(tmp_path, battery_fraction=0.1) as robot:
            for task in (("fetch", "red_can"), ("follow", "red_can"), ("park",)):
                code, said = await robot.command(*task)
                assert (code, said) == (3, "cocoro: refused: the battery is low (10%); charge the robot first\n")
            reply = await robot.ask(asked("fetch", label="red_can"))
            assert (reply.accepted, reply.refusal) == (False, "battery")

    asyncio.run(scenario())
