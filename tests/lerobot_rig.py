"""A robot that is recorded with tasks, pictures, states and commands, for tests of the LeRobotDataset."""

from __future__ import annotations

import asyncio
from collections.abc import Container
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from capture_rig import ROBOT, STILL, Room, frame, record

from apps.captures.export.lerobot_episodes import Episode, Recording, recorded_tasks
from cocoro import topics
from cocoro.capture.tables import Tables
from cocoro.clock import NS
from cocoro.joints import GROUPS
from cocoro.messages import BaseCommand, BaseState, Outcome, ServoCommand, ServoState, TaskState

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
JOINTS = [*ROBOT.joints]
SPEED, TURN = len(JOINTS), len(JOINTS) + 1


def libraries() -> tuple[Any, Any]:
    """pyarrow.parquet and PyAV; the test is skipped where they are not installed."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed (extra lerobot)")
    return parquet, pytest.importorskip("av", reason="PyAV is not installed (extra lerobot)")


class Told(NamedTuple):
    """A task from one tick to another, 50 ticks a second."""

    label: str
    first: int
    last: int
    outcome: Outcome | None = "done"


def angle(joint: str, tick: int) -> float:
    return JOINTS.index(joint) + tick / 1000


async def run(
    room: Room, tasks: tuple[Told, ...], ticks: int = 120, blind: Container[int] = (), numb: Container[int] = (),
    size: tuple[int, int] = (16, 12),
) -> None:  # fmt: skip
    """States at 50 Hz, pictures at 10 Hz except at `blind` ticks, no states of the arm at `numb` ones. Commands from
    tick 30 on: the neck's pan alone, with the base until tick 60; from tick 80 on the pan is held."""
    names = ("base", "arm", "hand", "kinect", "executive", "planning")
    base, arm, hand, kinect, executive, planning = nodes = [room.node(name) for name in names]
    for node in nodes:
        await node.__aenter__()
        node.ready()
    for tick in range(ticks):
        moving = {**STILL, "speed_mps": tick / 100, "aside_mps": tick / 200}
        base.publish(topics.BASE_STATE, BaseState(odometry_m=(0.0, 0.0), **moving))
        for node, topic, group in zip((arm, hand), (topics.ARM_STATE, topics.HAND_STATE), GROUPS, strict=True):
            if node is hand or tick not in numb:
                joints = ROBOT.group_joints(group)
                still = (0.0,) * len(joints)
                angles = tuple(angle(joint, tick) for joint in joints)
                node.publish(topic, ServoState(joints=joints, position_rad=angles, speed_radps=still, load=still))
        if tick % 5 == 0 and tick not in blind:
            kinect.publish(topics.FRAME, frame(tick, *size))
        for told in tasks:
            if tick in (told.first, told.last):
                ended = told.outcome if tick == told.last else None
                begun: Any = {"task_id": told.label, "task": "fetch", "started_ns": at(told.first)}
                executive.publish(topics.TASK, TaskState(label=told.label, outcome=ended, **begun))
        if tick >= 30:
            goal = ServoCommand(joints=("neck_pan",), goal_rad=(0.5,), speed_radps=(0.0 if tick >= 80 else 1.0,))
            planning.publish(topics.ARM_COMMAND, goal)
        if 30 <= tick < 60:
            planning.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.15, turn_radps=0.4, aside_mps=0.1))
        await asyncio.sleep(0.02)
    for node in nodes:
        await node.__aexit__(None, None, None)


def at(tick: int) -> int:
    return BEGUN_NS + tick * NS // 50


BEGUN_NS = NS // 1000
"""When `record` lets a scenario begin."""


def recorded(path: Path, *tasks: Told, **how: Any) -> Path:
    return record(path, lambda room: run(room, tasks, **how))


WHOLE = Told("red_can", 10, 110)


def episode_of(path: Path, rate_hz: int = 10, number: int = 0) -> Episode:
    with Tables.open(path) as capture:
        return Recording(capture, ROBOT).episode(recorded_tasks(capture)[number], rate_hz)
