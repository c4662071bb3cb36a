"""Perception's shell: the core, driven by the node."""

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
    """Perception's maths. Raises ConfigError for a bad file of known objects."""
    # A frame takes a few milliseconds: spreading it over threads would only take the other services' cores.
    cv2.setNumThreads(1)
    return PerceptionCore(robot, config, Catalogue.load(Path(config.objects) if config.objects else None))


async def run(node: Node, config: PerceptionConfig) -> None:
    """Look at every frame that arrives, until cancelled. Raises ConfigError for a bad file of known objects."""
    await node.drive(core(node.robot, config))


implementation = Implementation(PerceptionConfig, run, core)
