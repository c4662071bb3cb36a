"""A viewer as Foxglove is one: a WebSocket client of its protocol, as small as tests need it."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

PROTOCOL = "foxglove.sdk.v1"
TEXT, BINARY, CLOSE = 1, 2, 8
MESSAGE, ANSWER = 1, 3
"""First byte of a binary message: data of a subscription, the answer of a service."""
PATIENCE_S = 30.0


class Viewer:
    """Connects to a server's address, `ws://...`, and learns its topics and services. A context manager."""

    def __init__(self, address: str, origin: str | None = None) -> None:
        """`origin`: whose page it is on, as a browser says. Raises ConnectionError with the server's text when it is
        refused."""
        where = urlsplit(address)
        assert where.hostname is not None
        self._socket = socket.create_connection((where.hostname, where.port or 80), PATIENCE_S)
        self._bytes = self._socket.makefile("rb")
        self.channels: dict[str, dict[str, Any]] = {}
        """What the server says of each topic."""
        self.services: dict[str, dict[str, Any]] = {}
        self.topics: dict[int, str] = {}
        """The topic of each subscription."""
        try:
            self._greet(where.netloc, origin)
        except BaseException:
            self.close()
            raise

    def _greet(self, netloc: str, origin: str | None) -> None:
        key = base64.b64encode(os.urandom(16)).decode()
        came = "" if origin is None else f"Origin: {origin}\r\n"
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: {netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"{came}"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n"
            .encode()
        )  # fmt: skip
        if b"101" not in self._bytes.readline():
            raise ConnectionError(self._bytes.read().decode())
        while self._bytes.readline().strip():
            pass
        while not self.channels:
            self.next()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._bytes.close()
        self._socket.close()

    def subscribe(self, *topics: str) -> None:
        fresh = {len(self.topics) + number: topic for number, topic in enumerate(topics, start=1)}
        self.topics |= fresh
        wanted = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in fresh.items()]
        self._send(TEXT, json.dumps({"op": "subscribe", "subscriptions": wanted}).encode())

    def message(self, topic: str) -> bytes:
        """The next message of a topic that it has subscribed to."""
        while True:
            kind, content = self.next()
            if kind == BINARY and content[0] == MESSAGE:
                number, _stamp_ns = struct.unpack_from("<IQ", content, 1)
                if self.topics[number] == topic:
                    return content[13:]

    def ask(self, service: str, **question: Any) -> dict[str, Any]:
        """The answer of a service. Raises RuntimeError with the server's text when it has failed."""
        while service not in self.services:
            self.next()
        head = struct.pack("<BIII", 2, self.services[service]["id"], 7, len(b"json"))
        self._send(BINARY, head + b"json" + json.dumps(question).encode())
        while True:
            kind, content = self.next()
            if kind == BINARY and content[0] == ANSWER:
                answer: dict[str, Any] = json.loads(content[13 + len(b"json") :])
                return answer
            if kind == TEXT and (said := json.loads(content))["op"] == "serviceCallFailure":
                raise RuntimeError(said["message"])

    def next(self) -> tuple[int, bytes]:
        """The kind and the content of the next message. What it says of topics and services is kept."""
        first, length = self._bytes.read(2)
        if length == 126:
            (length,) = struct.unpack("!H", self._bytes.read(2))
        elif length == 127:
            (length,) = struct.unpack("!Q", self._bytes.read(8))
        content = self._bytes.read(length)
        kind = first & 0x0F
        if kind == TEXT:
            said = json.loads(content)
            if said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
            elif said["op"] == "advertiseServices":
                self.services |= {service["name"]: service for service in said["services"]}
        assert kind != CLOSE, "the server has closed the connection"
        return kind, content

    def _send(self, kind: int, content: bytes) -> None:
        mask = os.urandom(4)
        size = len(content)
        head = bytes([0x80 | kind]) + (
            bytes([0x80 | size]) if size < 126 else bytes([0x80 | 126]) + struct.pack("!H", size)
        )
        self._socket.sendall(head + mask + bytes(byte ^ mask[n % 4] for n, byte in enumerate(content)))
