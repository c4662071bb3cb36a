"""What both buses make of a server: its answer, or its error in words."""

from __future__ import annotations

import logging

from cocoro.bus.base import Payload, Reply, Server
from cocoro.errors import CocoroError

log = logging.getLogger(__name__)


async def answer(server: Server, key: str, payload: Payload) -> Reply:
    """Ask a server. A CocoroError's text goes to the caller; anything else is a bug, logged here and said there."""
    try:
        return Reply(key, True, bytes(await server(key, payload)))
    except CocoroError as error:
        return Reply(key, False, str(error).encode())
    except Exception as error:
        log.exception("the server of %s failed", key)
        return Reply(key, False, f"internal error: {type(error).__name__}: {error}".encode())
