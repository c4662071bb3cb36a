"""The file of the body's motion: a row for each physics step, in agreement with the world's pose."""

from __future__ import annotations

from math import hypot
from pathlib import Path

import pytest

from cocoro.errors import ConfigError
from cocoro.robot import Robot
from sim.motion import MotionWriter, read_motion
from sim.scene import Scene
from sim.world import World

pytestmark = pytest.mark.sim

ROBOT = Robot.load()


def test_each_step_has_its_row_and_the_rows_add_up_to_the_way(tmp_path: Path) -> None:
    file = tmp_path / "motion"
    with World(ROBOT, Scene(name="empty")) as world, MotionWriter(file, world) as writer:
        world.set_latch("released")
        start = world.body_pose()
        for step in range(240):
            if step < 120 and step % 5 == 0:
                world.command_base(ROBOT.drive.command_of((0.3, 0.2), world.time_ns))
            world.step()
            writer.step()
        writer.flush()
        rows = read_motion(file)
        end = world.body_pose()
    assert [row.sim_ns for row in rows] == [n * 10**9 // 240 for n in range(1, 241)]
    assert [row.real_ns for row in rows] == sorted(row.real_ns for row in rows)
    assert sum(row.speed_mps for row in rows) / 240 >= hypot(*(end - start)[:2, 3]) > 0.08
    driving = rows[110]
    assert driving.speed_mps == pytest.approx(0.25, abs=0.01)
    assert driving.rim_mps == pytest.approx(0.05, abs=0.01)
    assert driving.asked_mps == pytest.approx(0.3)
    assert driving.moves_mps == driving.speed_mps
    assert not driving.no_command
    assert rows[-1].no_command
    assert rows[-1].moves_mps < 0.01
    assert read_motion(file, after=200) == rows[200:]


def test_half_a_row_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "motion"
    with World(ROBOT, Scene(name="empty")) as world, MotionWriter(file, world) as writer:
        world.step()
        writer.step()
        writer.flush()
        file.write_bytes(file.read_bytes() + b"part")
        assert len(read_motion(file)) == 1


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with World(ROBOT, Scene(name="empty")) as world, pytest.raises(ConfigError, match=r"nowhere.*can be written"):
        MotionWriter(tmp_path / "nowhere" / "motion", world)
