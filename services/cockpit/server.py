"""The HTTP server: uvicorn in the node's event loop, on a socket of our own.

uvicorn speaks HTTP by h11 and WebSocket by the `websockets` library's protocol without input and output: it is kept up,
masks in C, and reads the next message of a page only when the last was taken, so nothing piles up. Messages are not
compressed: pictures are compressed already, and the time counts.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from functools import partial

import uvicorn

from cocoro.errors import ConfigError
from services.cockpit.access import App, Gate
from services.cockpit.access_door import BACKLOG
from services.cockpit.access_passage import Passage
from services.cockpit.access_serving import HEAD_BYTES, DoorServer, keep_renewed, open_door
from services.cockpit.access_tls import Entrance

PORTS = 10
"""Ports that are tried, from the wanted one on."""
MESSAGE_BYTES = 64 * 1024
"""Largest message of a page."""
UNSENT_BYTES = 32 * 1024
"""What may wait in the kernel for a slow network, so that a state that a page gets is not seconds old there."""
ENDING_S = 1
"""Longest wait, at the end, for connections to close."""


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens at the wanted port, or at the next free one. Raises ConfigError when there is none."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    tries = range(port, min(port + PORTS, 65536)) if port else (0,)
    for tried in tries:
        found = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)  # connections inherit it
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            found.bind((host, tried))
            found.listen(BACKLOG)
        except OSError as error:
            found.close()
            if error.errno != errno.EADDRINUSE:
                raise ConfigError(
                    f"[service.cockpit] host = {host!r}, port = {tried}: {error.strerror}; choose another"
                ) from error
            continue
        found.setblocking(False)
        return found
    raise ConfigError(f"[service.cockpit] the ports {tries[0]} to {tries[-1]} of {host} are all taken: choose another")


@asynccontextmanager
async def serving(app: App, gate: Gate, listening: socket.socket, entrance: Entrance) -> AsyncIterator[None]:
    """Serve an ASGI application behind a gate while the context lasts. Raises ConfigError."""
    logging.getLogger("uvicorn").setLevel(logging.ERROR)  # door and gate log what is malformed, without a flood
    logging.getLogger("uvicorn.error").addFilter(_of_ours)
    config = uvicorn.Config(
        Passage(gate, app), loop="none", http="h11", ws="websockets-sansio", lifespan="off", log_config=None,
        log_level="error", access_log=False, proxy_headers=False, server_header=False, date_header=False,
        interface="asgi3", ws_max_size=MESSAGE_BYTES, ws_per_message_deflate=False,
        h11_max_incomplete_event_size=HEAD_BYTES, timeout_graceful_shutdown=ENDING_S,
    )  # fmt: skip
    config.load()
    server = DoorServer(config, partial(open_door, gate, listening, entrance))
    server.lifespan = config.lifespan_class(config)
    await server.startup(sockets=[listening])
    context = gate.door.context if gate.door is not None else None
    renewing = asyncio.ensure_future(keep_renewed(context, entrance))
    try:
        yield
    finally:
        renewing.cancel()
        with suppress(OSError):
            await server.shutdown(sockets=[listening])


def _of_ours(record: logging.LogRecord) -> bool:
    """Whether a line of uvicorn's is of a fault here, and not of a client that sends rubbish."""
    return "Invalid UTF-8" not in str(record.msg)
