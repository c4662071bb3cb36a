"""The executive as a service."""

from __future__ import annotations

from pathlib import Path

from cocoro.node import Node
from cocoro.objects import Catalogue
from services.executive.config import Config
from services.executive.executive import Executive

__all__ = ["Config", "run"]


async def run(node: Node, config: Config) -> None:
    """Take tasks until the service is ended."""
    catalogue = Catalogue.load(Path(config.objects) if config.objects else None)
    executive = Executive(node, config, catalogue)
    node.ready()
    await executive.publish_progress()
