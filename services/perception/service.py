"""Perception's shell: the node drives the core."""

from __future__ import annotations

from pathlib import Path

import cv2

from cocoro.component import Implementation
from cocoro.node import Node
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore


def core(robot: Robot, config: PerceptionConfig) -> PerceptionCore:
    """Returns perception's core. Raises ConfigError for a bad catalogue file."""
    # A frame takes a few milliseconds; several threads would only take the other services' cores.
    cv2.setNumThreads(1)
    return PerceptionCore(robot, config, Catalogue.load(Path(config.objects) if config.objects else None))


async def run(node: Node, config: PerceptionConfig) -> None:
    """Process every frame until cancelled. Raises ConfigError for a bad catalogue file."""
    await node.drive(core(node.robot, config))


implementation = Implementation(PerceptionConfig, run, core)
