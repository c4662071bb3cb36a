"""The cockpit as a service."""

from __future__ import annotations

import asyncio

from cocoro.component import Implementation
from cocoro.errors import ConfigError
from cocoro.node import Node
from services.cockpit import access_tls, server
from services.cockpit.access_people import People, folder_of
from services.cockpit.access_serving import gate_of
from services.cockpit.app import App
from services.cockpit.cockpit import Cockpit
from services.cockpit.config import CockpitConfig


async def run(node: Node, config: CockpitConfig) -> None:
    """Serve the page until the service is ended. Where it cannot be served, health says why, and the robot works."""
    cockpit, people = Cockpit(node, config), People(folder_of(node.robot_name))
    try:
        entrance = access_tls.entrance(config)
        listening = server.listen(entrance.host, config.port)
    except ConfigError as error:
        node.log.error("%s", error)
        node.degraded(str(error))
        node.report_health()
        await asyncio.get_running_loop().create_future()
        return
    url = entrance.url(listening.getsockname()[1])
    gate = gate_of(entrance, node.robot_name, people, config.site)
    people.serves(url if entrance.served is not None else None)
    async with server.serving(App(cockpit, gate).asgi, gate, listening, entrance):
        if config.port and f":{config.port}/" not in url:
            node.log.warning("port %d is taken: the page is at %s", config.port, url)
        node.ready(url)
        node.report_health()  # `cocoro up` says the address
        await cockpit.run()


implementation = Implementation(CockpitConfig, run)
