"""What stands between the network and the cockpit's application: door, gate, and uvicorn between them.

uvicorn's protocols get the connections that the door has taken.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import uvicorn

from cocoro.errors import ConfigError
from services.cockpit.access import Certificates, Gate
from services.cockpit.access_certificates import SiteCertificates
from services.cockpit.access_door import Door, Protocols
from services.cockpit.access_people import People
from services.cockpit.access_tls import Entrance

log = logging.getLogger("cocoro.cockpit.access")

HEAD_BYTES = 16 * 1024
"""Of a request's head."""
RENEWED_S = 60.0
"""Time between two looks for a certificate that was renewed."""


def gate_of(entrance: Entrance, robot: str, people: People, site: str = "") -> Gate:
    """The gate of a robot's cockpit; `site` is the folder of the site whose persons have certificates."""
    certificates = SiteCertificates(Path(site), robot, complain=log.error) if site else Certificates()
    return Gate(names=entrance.names, tls=entrance.served is not None, people=people, certificates=certificates)


def open_door(gate: Gate, listening: socket.socket, entrance: Entrance, protocols: Protocols) -> Door:
    """The door before a gate. Raises ConfigError when the certificate has gone since the entrance was found."""
    gate.door = Door(
        listening, protocols, context=entrance.context(), local_only=not entrance.beyond, limits=gate.door_limits,
        audit=gate.audit,
    )  # fmt: skip
    return gate.door


async def keep_renewed(context: ssl.SSLContext | None, entrance: Entrance) -> None:
    """Takes a renewed certificate for new connections, for ever."""
    served = entrance.served
    if context is None or served is None:
        return
    known = served.stamp()
    while True:
        await asyncio.sleep(RENEWED_S)
        try:
            if (now := served.stamp()) != known:
                context.load_cert_chain(served.cert, served.key)
                known = now
                log.info("%s: taken anew", served.cert)
        except (OSError, ConfigError) as error:  # of which ssl.SSLError is one; a copy may be half done
            log.warning("%s: not taken anew: %s", served.cert, error)


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
