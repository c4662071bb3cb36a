"""The HTTP server: uvicorn in the node's event loop, on a socket of our own.

uvicorn speaks HTTP by h11 and WebSocket by the `websockets` library's protocol without input and output: it is kept up,
masks in C, and reads the next message of a page only when the last was taken, so nothing piles up. Messages are not
compressed: pictures are compressed already, and the time counts.
"""

from __future__ import annotations

import errno
import logging
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import uvicorn

from cocoro.errors import ConfigError

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
            found.listen(64)
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


def address(listening: socket.socket, scheme: str = "http") -> str:
    """The URL of the page."""
    host, port = listening.getsockname()[:2]
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"


@asynccontextmanager
async def serving(app: Any, listening: socket.socket, **options: Any) -> AsyncIterator[None]:
    """Serve an ASGI application while the context lasts. `options` are uvicorn's, for TLS."""
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    config = uvicorn.Config(
        app, loop="none", http="h11", ws="websockets-sansio", lifespan="off", log_config=None, log_level="warning",
        access_log=False, proxy_headers=False, server_header=False, date_header=False, interface="asgi3",
        ws_max_size=MESSAGE_BYTES, ws_per_message_deflate=False, timeout_graceful_shutdown=ENDING_S, **options,
    )  # fmt: skip
    config.load()
    server = uvicorn.Server(config)
    server.lifespan = config.lifespan_class(config)
    await server.startup(sockets=[listening])
    try:
        yield
    finally:
        with suppress(OSError):
            await server.shutdown(sockets=[listening])
