"""uvicorn behind the door: its protocols get the connections that the door has taken."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any, cast

import uvicorn

from services.cockpit.access_door import Door, Protocols

HEAD_BYTES = 16 * 1024
"""Of a request's head."""


class DoorServer(uvicorn.Server):
    """A server that does not listen by itself."""

    def __init__(self, config: uvicorn.Config, open_door: Callable[[Protocols], Door]) -> None:
        super().__init__(config)
        self._open_door = open_door

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await self.lifespan.startup()
        loop = asyncio.get_running_loop()
        make = cast(Callable[..., asyncio.Protocol], self.config.http_protocol_class)

        def protocol() -> asyncio.Protocol:
            return make(config=self.config, server_state=self.server_state, app_state=self.lifespan.state, _loop=loop)

        door = self._open_door(protocol)
        door.start()
        self.servers = cast(Any, [door])
        self.started = True
