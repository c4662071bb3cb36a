"""The floor scanner: what it tells of a depth image besides points and free floor."""

from __future__ import annotations

import numpy as np
import pytest

from cocoro.robot import Robot
from services.perception.config import PerceptionConfig
from services.perception.floor import BLOCKS, STEP_M, FloorScanner
from services.perception.image import RgbdImage

ROBOT = Robot.load()
WIDTH = 160


@pytest.mark.parametrize("height", [120, 100])
def test_the_nearest_depth_of_a_block_is_that_of_its_nearest_pixel(height: int) -> None:
    depth = np.random.default_rng(3).uniform(0.8, 3.0, (height, WIDTH))
    image = RgbdImage(np.zeros((height, WIDTH, 3), np.uint8), ROBOT.depth_code(depth), ROBOT)
    told = np.frombuffer(FloorScanner(ROBOT, PerceptionConfig()).nearest(image), np.uint8).reshape(BLOCKS)
    seen = ROBOT.depth_m(image.raw_depth)
    for row, column in ((0, 0), (13, 7), (BLOCKS[0] - 1, BLOCKS[1] - 1)):
        rows = slice(row * height // BLOCKS[0], (row + 1) * height // BLOCKS[0])
        columns = slice(column * WIDTH // BLOCKS[1], (column + 1) * WIDTH // BLOCKS[1])
        assert told[row, column] == int(seen[rows, columns].min() / STEP_M)
