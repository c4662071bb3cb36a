"""What both WebSockets share: reading messages, and the form of answers."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, TypeVar

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.cockpit.asking import Reply
from services.cockpit.orders import Id
from services.cockpit.scene import encoded

M = TypeVar("M")

MALFORMED = 1008
"""The code with which a connection is closed that sent what is no message."""
REASON_BYTES = 120
"""A closing frame's reason takes 123 bytes at most."""


async def spoken(socket: WebSocket, decoder: msgspec.json.Decoder[M]) -> M | None:
    """The page's next message; None at the end of the connection, also of one that this ends, with the reason, for
    what is no message of the protocol."""
    message = await socket.receive()
    if message["type"] != "websocket.receive":
        return None
    try:
        return decoder.decode(message.get("text") or message.get("bytes") or b"")
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        reason = f"not a message of the protocol: {error}".encode()[:REASON_BYTES].decode(errors="ignore")
        with suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(MALFORMED, reason)
        return None


def reply_text(id: Id, reply: Reply) -> str:
    """An answer to a page's request."""
    message = {"kind": "reply", "id": id, "ok": reply.ok, "text": reply.text}
    return encoded(message | ({"data": reply.data} if reply.data is not None else {}))


def stop_reply(id: Id, told: dict[str, Any]) -> str:
    """The answer to a stop, when it is over."""
    return reply_text(id, Reply(stopped(told), stop_text(told), told))


def stopped(told: dict[str, Any]) -> bool:
    """Whether everything that moves has acknowledged a stop."""
    return bool(told["acknowledged"]) and not told["missing"]


def stop_text(told: dict[str, Any]) -> str:
    """The end of a stop as a sentence."""
    acknowledged = ", ".join(told["acknowledged"])
    text = f"stopped: {acknowledged}" if acknowledged else "nothing has acknowledged the stop"
    if told["missing"]:
        text += f"; NOT ACKNOWLEDGED by {', '.join(told['missing'])}"
    return f"{text}; {told['trouble']}" if told["trouble"] else text
