"""Policies in the whole robot, in virtual time, judged by the true state: what they reach, and what they cannot do."""

from __future__ import annotations

from pathlib import Path

import pytest
from policy_rig import let, rig
from robot_rig import SMALL_FRAMES

from cocoro.testing import in_virtual_time

pytestmark = pytest.mark.sim


@in_virtual_time
async def test_a_policy_brings_the_arm_to_a_posture_and_finishes() -> None:
    async with rig() as robot:
        state = await robot.run("policy", "out")
        assert (state.outcome, state.reason) == ("done", "")
        joints, wanted = robot.truths[-1].joints_rad, robot.robot.poses["upright"]
        assert {name: joints[name] for name in wanted} == pytest.approx(wanted, abs=0.12)
        assert not any(truth.collisions for truth in robot.truths)


@in_virtual_time
async def test_a_policy_that_falls_silent_ends_its_task_and_the_robot_stands() -> None:
    async with rig() as robot:
        task_id = await robot.begin("policy", "ahead")
        await robot.until(lambda: robot.speed_mps > 0.1)
        await robot.kill("policy")
        state = await robot.outcome(task_id)
        assert state.outcome == "failed"
        assert state.reason.startswith("silent: no actions of ahead that count for 1.0 s")
        assert robot.speed_mps < 0.01


@in_virtual_time
async def test_a_policy_that_wants_to_go_into_a_wall_touches_nothing(tmp_path: Path) -> None:
    wall_m, scene = 1.2, tmp_path / "wall.toml"
    box = f'shape = "box"\nsize_m = [0.1, 1.6, 0.6]\nposition_m = [{wall_m + 0.05}, 0.0]\n'
    scene.write_text(f'name = "wall"\n\n[[obstacle]]\n{box}', encoding="utf-8")
    async with rig({"sim": {**SMALL_FRAMES, "scene": str(scene)}}) as robot:
        state = await let(robot, "into", 14.0)
        assert state.outcome == "done"
        assert not any(truth.collisions for truth in robot.truths)
        body_m = robot.truths[-1].body_m[0]
        assert body_m > 0.15  # it did drive
        assert robot.speed_mps < 0.01


@in_virtual_time
async def test_a_policy_that_wants_the_impossible_hurts_nobody() -> None:
    async with rig() as robot:
        state = await let(robot, "impossible", 8.0)
        assert state.outcome == "done"
        assert not any(truth.collisions for truth in robot.truths)
        for name, joint in robot.robot.joints.items():
            low, high = joint.limits_rad
            assert all(low - 0.03 <= truth.joints_rad[name] <= high + 0.03 for truth in robot.truths)


@in_virtual_time
async def test_what_cannot_be_followed_ends_the_task_with_the_reason() -> None:
    async with rig() as robot:
        state = await robot.run("policy", "notfinite")
        assert state.outcome == "failed"
        assert state.reason.startswith("refused: policy notfinite: its action ")


@in_virtual_time
async def test_an_emergency_stop_holds_a_policy_up_and_without_its_service_no_task_starts() -> None:
    async with rig() as robot:
        task_id = await robot.begin("policy", "ahead")
        await robot.until(lambda: robot.speed_mps > 0.1)
        await robot.estop(True)
        await robot.advance(0.5)
        assert robot.speed_mps < 0.01
        assert (await robot.outcome(task_id)).outcome == "failed"
        await robot.estop(False)
        await robot.kill("policy")
        await robot.advance(0.5)
        reply = await robot.ask("policy", "ahead")
        assert (reply.refusal, "policy" in reply.text) == ("not_alive", True)
