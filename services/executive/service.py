"""The executive as a service."""

from __future__ import annotations

from pathlib import Path

from cocoro.component import Implementation
from cocoro.node import Node
from cocoro.objects import Catalogue
from services.executive.config import ExecutiveConfig
from services.executive.executive import Executive


async def run(node: Node, config: ExecutiveConfig) -> None:
    """Take tasks until the service is ended."""
    catalogue = Catalogue.load(Path(config.objects) if config.objects else None)
    executive = Executive(node, config, catalogue)
    await executive.settle()
    node.ready()
    await executive.publish_progress()


implementation = Implementation(ExecutiveConfig, run)
