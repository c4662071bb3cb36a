"""The services of arm, hand and base of a robot that stands on servos, too: one process has each line open."""

from __future__ import annotations

from cocoro.component import Implementation
from cocoro.errors import ConfigError
from cocoro.node import Node
from services.servos.service import ServosConfig, serve


async def run(node: Node, config: ServosConfig) -> None:
    """Serve for ever. Raises ConfigError for a robot whose wheels are not turned by servos."""
    if node.robot.wheel_line is None:
        raise ConfigError(f"no servos turn the wheels of {node.robot.name}: name the processes `base` and `servos`")
    async with node.sibling("base") as base:
        await serve(node, config, base)


implementation = Implementation(ServosConfig, run)
