"""The door before Foxglove's server, which asks nobody where he comes from: pages of others do not get through.

A page on the web can make the browser that shows it connect to this machine. The browser then says whose page it is, in
the header `Origin`, which the page cannot forge. The server itself listens where no page finds it: at an address of
this machine that is drawn anew each time, one of 16 million.
"""

from __future__ import annotations

import asyncio
import os
import secrets
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from urllib.parse import urlsplit

from cocoro.errors import ConfigError
from services.cockpit.access_peer import Address

HEAD_BYTES, HEAD_S = 8192, 5.0
"""The longest head of a request, and the longest time that it may take."""
MOST = 32
"""Connections at a time."""
CHUNK_BYTES = 1 << 16
FOXGLOVE = "foxglove.dev"


def hidden_address() -> str:
    """An address of this machine that nobody knows: 127.x.y.z."""
    return ".".join(map(str, (127, 1 + secrets.randbelow(254), secrets.randbelow(256), 1 + secrets.randbelow(254))))


def why_not(head: bytes) -> str:
    """Why a request with this head is not let through; '' when it is: programs are, for they send no origin, and so are
    the pages of Foxglove."""
    lines = head.decode("latin-1").split("\r\n")[1:]
    if any(line[:1] in (" ", "\t") for line in lines):
        return "a header of several lines"
    fields = [line.partition(":") for line in lines if line]
    origins = [value.strip() for name, _, value in fields if name.strip().lower() == "origin"]
    for origin in origins:
        parts = urlsplit(origin)
        host = parts.hostname or ""
        own = parts.scheme == "https" and (host == FOXGLOVE or host.endswith(f".{FOXGLOVE}"))
        program = parts.scheme not in ("", "http", "https")  # the desktop program's own pages
        if not (own or program):
            return f"a page of {origin!r} may not reach the robot; open it in Foxglove"
    return ""


class Door:
    """Listens for viewers and passes on what they and the server say. An asynchronous context manager."""

    def __init__(
        self,
        host: str,
        port: int,
        inner: tuple[str, int],
        user_of: Callable[[Address, Address], int | None] | None = None,
    ) -> None:
        """`host`, `port`: where viewers come; port 0 is any free one. `inner`: where the server is. `user_of`: the user
        whose process has the one end of a connection, of which the other end is here; then only processes of this
        user, and of root, are let through.
        """
        self._host, self.port = host, port
        self._inner = inner
        self._user_of = user_of
        self._open: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> Door:
        """Raises ConfigError when nobody can listen there."""
        try:
            self._server = await asyncio.start_server(self._come, self._host, self.port, limit=HEAD_BYTES)
        except OSError as error:
            why = error.strerror or error
            raise ConfigError(
                f"Foxglove cannot be served at {self._host}:{self.port} ({why}); give another --port"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server.close()
        for passing in self._open:
            passing.cancel()
        await asyncio.gather(*self._open, return_exceptions=True)

    async def _come(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        passing = asyncio.current_task()
        assert passing is not None
        self._open.add(passing)
        try:
            with suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
                await self._let_through(reader, writer)
        except asyncio.CancelledError:  # the door shuts: what a viewer has not taken by now is not waited for
            writer.transport.abort()
            raise
        finally:
            self._open.discard(passing)
            writer.close()

    async def _let_through(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(HEAD_S):
            head = await reader.readuntil(b"\r\n\r\n")
        refused = self._why_not_them(writer) or why_not(head) or ("too many viewers" if len(self._open) > MOST else "")
        if refused:
            text = f"{refused}\n".encode()
            writer.write(
                b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain; charset=utf-8\r\nConnection: close\r\n"
                + f"Content-Length: {len(text)}\r\n\r\n".encode()
                + text
            )
            await writer.drain()
            return
        their_reader, their_writer = await asyncio.open_connection(*self._inner)
        their_writer.write(head)
        ways = [
            asyncio.ensure_future(_pass_on(reader, their_writer)),
            asyncio.ensure_future(_pass_on(their_reader, writer)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            their_writer.transport.abort()
            raise
        finally:
            for way in ways:
                way.cancel()
            their_writer.close()  # before the wait, which a door that shuts ends
            await asyncio.gather(*ways, return_exceptions=True)

    def _why_not_them(self, writer: asyncio.StreamWriter) -> str:
        """Why a process is not let through, whatever it asks; '' when it is."""
        if self._user_of is None:
            return ""
        there, here = writer.get_extra_info("peername")[:2], writer.get_extra_info("sockname")[:2]
        if self._user_of(there, here) in (os.getuid(), 0):
            return ""
        return "this robot takes tasks from its owner's programs alone"


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Until the one side ends or the other one is gone."""
    while data := await reader.read(CHUNK_BYTES):
        writer.write(data)
        await writer.drain()
