"""A program operates the whole simulated robot in virtual time, by the client that it would use live."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from math import hypot
from typing import Any

import numpy as np
import pytest
from robot_rig import HALTED_MPS, SMALL_FRAMES, RobotRig

import cocoro
from apps.client.robot import RobotClient
from apps.client.stopping import NotStoppedError
from cocoro.clock import VirtualClock
from cocoro.errors import ConfigError, MeshError
from cocoro.messages import BaseState
from cocoro.testing import in_virtual_time
from cocoro.topics import BASE_STATE

pytestmark = pytest.mark.sim


@asynccontextmanager
async def operated(rig: RobotRig) -> AsyncIterator[RobotClient]:
    """A program's client of a robot that takes tasks."""
    async with cocoro.connect("calliope", bus=rig.mesh.join(), clock=VirtualClock()) as robot:
        async with asyncio.timeout(5.0):
            while not (await robot.status()).ready:
                await rig.advance(0.1)
        yield robot


def place_m(rig: RobotRig) -> tuple[float, float]:
    return rig.truths[-1].body_m[0], rig.truths[-1].body_m[1]


@in_virtual_time
async def test_a_can_is_fetched_put_down_and_the_arm_parked() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        phases = list[str]()
        fetch = robot.fetch("red_can")
        async for state in fetch:
            phases += [state.phase] if state.phase not in phases else []
        assert rig.held("red_can")
        assert phases[-1] == "end"
        assert {"search", "approach", "reach", "grasp", "lift"} <= {*phases}
        assert (await fetch).elapsed_s > 1.0
        with pytest.raises(cocoro.HoldingError, match="put it down first"):
            await robot.go_to("green_can")
        assert (await robot.put_down()).task == "put-down"
        assert not rig.held("red_can")
        assert (await robot.park()).task == "park"


@in_virtual_time
async def test_it_goes_to_an_object_and_touches_it() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        await robot.go_to("red_can", distance_m=0.53)
        can = rig.thing("red_can")
        away_m = hypot(can.position_m[0] - place_m(rig)[0], can.position_m[1] - place_m(rig)[1])
        assert away_m == pytest.approx(0.53 + 0.033, abs=0.06)
        result = await robot.touch("red_can")
        assert result.label == "red_can"


@in_virtual_time
async def test_it_follows_an_object_for_a_time() -> None:
    settings: dict[str, Any] = {"sim": {**SMALL_FRAMES, "scene": "follow"}}
    async with RobotRig(settings=settings) as rig, operated(rig) as robot:
        result = await robot.follow("blue_ball", for_s=8.0)
        assert result.elapsed_s == pytest.approx(8.0, abs=2.0)
        assert result.measures["near_share"] > 0.5


@in_virtual_time
async def test_a_robot_refuses_in_words_and_by_kind() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        with pytest.raises(cocoro.UnknownLabelError, match=r"known are .*red_can"):
            await robot.fetch("teapot")
        with pytest.raises(cocoro.NotHoldingError):
            await robot.put_down()
        with pytest.raises(cocoro.BadRequestError, match="no_such_task"):
            await robot.run({"task": "no_such_task"})
        with pytest.raises(cocoro.BadRequestError, match="distance_m"):
            await robot.go_to("red_can", distance_m=-1.0)
        with pytest.raises(cocoro.NoTaskError):
            await robot.cancel()
        async with robot.park() as park:
            await park.accepted()
            with pytest.raises(cocoro.BusyError, match="park is running"):
                await robot.fetch("red_can")
            taken = robot.go_to("red_can", instead=True)
            await taken.accepted()
            with pytest.raises(cocoro.TaskCancelledError):
                await park
            await taken.cancel()
        await rig.kill("perception")
        with pytest.raises(cocoro.NotAliveError, match="perception"):
            await robot.park()
        with pytest.raises(ConfigError, match="did you mean base/state"):
            robot.watch("base/stat")


@in_virtual_time
async def test_what_it_sees_and_knows_is_told_as_arrays_and_records() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        await robot.go_to("red_can", distance_m=0.53)
        view = await robot.see()
        assert view.colour.shape == (240, 320, 3)
        assert view.depth_m.shape == (240, 320)
        assert "red_can" in view.labels
        can = next(one for one in view.detections or () if one.label == "red_can")
        assert can.depth_m is not None
        left, top, right, bottom = can.box_px
        within = view.depth_m[top:bottom, left:right]
        assert np.nanmedian(within) == pytest.approx(can.depth_m, abs=0.05)
        reds = view.colour[round(can.v_px), round(can.u_px)].astype(int)
        assert reds[0] > 2 * reds[1]
        assert view.png().startswith(b"\x89PNG")
        assert "red_can" in repr(view)
        assert (await robot.see(detections=False)).detections is None
        known = {one.label: one for one in await robot.objects()}
        assert known["red_can"].graspable
        assert known["red_can"].seen is not None
        await rig.kill("sim")
        with pytest.raises(MeshError, match="no frame"):
            await robot.see()


@in_virtual_time
async def test_who_watches_a_topic_gets_its_messages_and_pays_for_no_others() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        stamps_ns = []
        states = robot.watch(BASE_STATE)
        async for state in states:
            stamps_ns.append(state.stamp_ns)
            if len(stamps_ns) == 3:
                break
        await states.aclose()
        assert stamps_ns == sorted(set(stamps_ns))
        late: AsyncGenerator[BaseState, None] = robot.watch("base/state")
        await anext(late)
        await rig.advance(1.0)
        newest = await anext(late)
        assert rig.now_s - newest.stamp_ns / 1e9 < 0.1
        await late.aclose()
        assert [one for one in robot.participant._inboxes if one == BASE_STATE.name] == []


@in_virtual_time
async def test_it_is_driven_by_hand_for_as_long_as_a_program_says() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        from_m = place_m(rig)
        async with robot.drive() as drive:
            await drive.move(cocoro.Motion(speed_mps=0.2), for_s=1.5)
            assert drive.motion.zero
            assert drive.reply.tick
            await rig.advance(0.6)
            assert rig.speed_mps < HALTED_MPS
            with pytest.raises(cocoro.BusyError):
                await robot.park()
        to_m = place_m(rig)
        assert 0.1 < hypot(to_m[0] - from_m[0], to_m[1] - from_m[1]) < 0.4
        assert (await robot.status()).ready
        async with robot.drive() as drive:
            drive.motion = cocoro.Motion(speed_mps=0.2)
            await robot.cancel()
            with pytest.raises(cocoro.TaskCancelledError):
                await drive.move(cocoro.Motion(speed_mps=0.2), for_s=5.0)


@in_virtual_time
async def test_a_program_that_lets_go_right_after_a_motion_has_let_go() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        async with robot.drive() as drive:
            await drive.move(cocoro.Motion(turn_radps=0.2), for_s=0.5)
            left_s = rig.now_s
        assert rig.now_s - left_s < 2.0, "the task does not wait until it has been left alone for long"
        await robot.park()


@in_virtual_time
async def test_the_emergency_stop_fails_the_task_and_refuses_others_until_the_reset() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        task = robot.go_to("red_can")
        await task.accepted()
        await rig.until(lambda: rig.speed_mps > 0.1)
        stopped = await robot.stop()
        assert {"base", "arm", "hand"} <= {*stopped.acknowledged}
        assert stopped.absent == ()
        with pytest.raises(cocoro.TaskEndedError, match="emergency stop") as caught:
            await task
        assert caught.value.reason == "estop"
        await rig.advance(0.5)
        assert rig.speed_mps < HALTED_MPS
        with pytest.raises(cocoro.StoppedError):
            await robot.park()
        released = await robot.reset()
        assert released.services == ("arm", "base", "hand")
        await robot.park()


@in_virtual_time
async def test_a_stop_of_which_a_service_says_nothing_is_an_error() -> None:
    async with RobotRig() as rig, operated(rig) as robot:
        token = robot.participant.bus.declare_alive("calliope/arm/alive")
        await rig.kill("sim")
        with pytest.raises(NotStoppedError, match="NOT ACKNOWLEDGED by arm") as caught:
            await robot.stop()
        assert caught.value.missing == ("arm",)
        token.close()
        with pytest.raises(MeshError, match="no service that moves something"):
            await robot.stop()
        with pytest.raises(MeshError, match="no service that moves something"):
            await robot.reset()


@in_virtual_time
async def test_a_program_that_ends_in_the_middle_leaves_a_robot_that_stands() -> None:
    async with RobotRig() as rig:
        async with operated(rig) as robot:
            await robot.go_to("red_can").accepted()
            await rig.until(lambda: rig.speed_mps > 0.1)
        assert rig.speed_mps < HALTED_MPS
        client = rig.mesh.join()
        async with cocoro.connect("calliope", bus=client, clock=VirtualClock()) as robot:
            task = robot.go_to("red_can", distance_m=0.1)
            task_id = await task.accepted()
            await rig.until(lambda: rig.speed_mps > 0.1)
            client.kill()  # as a process that is killed
            state = await rig.outcome(task_id)
            assert (state.outcome, state.reason.partition(":")[0]) == ("cancelled", "asker_gone")
            await asyncio.sleep(0.1)
            assert rig.speed_mps < HALTED_MPS
