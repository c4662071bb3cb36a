"""The door before Foxglove's server: whom it lets through, and that it leaves nothing open."""

from __future__ import annotations

import asyncio
import gc
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import ip_address
from typing import Any

import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")

from foxglove_rig import serving
from foxglove_viewer import Viewer

from apps.captures.export.foxglove_server import FoxgloveServer
from apps.cli.foxglove_door import HEAD_BYTES, Door, hidden_address, why_not
from apps.cli.view_foxglove import address_of
from services.cockpit.access_peer import Peers

pytestmark = pytest.mark.zenoh  # a server that listens, and its threads: real time


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with serving() as made:
        yield made


@pytest.mark.parametrize(
    "origin",
    [None, "https://app.foxglove.dev", "https://foxglove.dev", "app://foxglove", "file://"],
)
def test_programs_and_the_pages_of_foxglove_are_let_through(server: FoxgloveServer, origin: str | None) -> None:
    assert through_the_door(server, origin) == ""


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "http://app.foxglove.dev", "https://foxglove.dev.evil.example",
     "https://evilfoxglove.dev", "http://127.0.0.1:8080", ""],
)  # fmt: skip
def test_pages_of_others_are_not_and_are_told_why(server: FoxgloveServer, origin: str) -> None:
    assert "may not reach the robot" in through_the_door(server, origin)


def test_with_tasks_only_programs_of_the_same_user_are_let_through(server: FoxgloveServer) -> None:
    peers = Peers()
    assert through_the_door(server, None, peers.user) == ""
    for stranger in (os.getuid() + 1, None):
        assert "its owner's programs" in through_the_door(server, None, lambda *_, user=stranger: user)
    peers.close()


def through_the_door(server: FoxgloveServer, origin: str | None, user_of: Any = None) -> str:
    """Why a viewer from there is refused; '' when he sees the robot."""

    def look(address: str) -> str:
        try:
            with Viewer(address, origin) as viewer:
                return "" if viewer.ask("/task/fetch", label="red_can")["accepted"] else "not accepted"
        except ConnectionError as refused:
            return str(refused)

    async def run() -> str:
        async with Door("127.0.0.1", 0, (server.host, server.port), user_of) as door:
            return await asyncio.to_thread(look, address_of("127.0.0.1", door.port))

    return asyncio.run(run())


def test_a_head_without_an_end_or_of_trickery_is_not_let_through() -> None:
    assert why_not(b"GET / HTTP/1.1\r\nOrigin:\r\n https://app.foxglove.dev\r\n\r\n")
    assert why_not(b"GET / HTTP/1.1\r\nORIGIN : https://evil.example\r\n\r\n")
    both = b"GET / HTTP/1.1\r\nOrigin: https://app.foxglove.dev\r\nOrigin: https://evil.example\r\n\r\n"
    assert why_not(both)

    async def run() -> int:
        async with Door("127.0.0.1", 0, ("127.0.0.1", 1)) as door:
            reader, writer = await asyncio.open_connection("127.0.0.1", door.port)
            try:
                writer.write(b"x" * 3 * HEAD_BYTES)
                return len(await reader.read())
            finally:
                writer.transport.abort()

    with suppress(ConnectionError):
        assert asyncio.run(run()) == 0


def test_a_door_that_shuts_leaves_no_socket_of_a_viewer_who_takes_nothing() -> None:
    async def flood(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while True:
                writer.write(bytes(HEAD_BYTES))
                await writer.drain()
                flooded.append(HEAD_BYTES)

    async def run() -> None:
        inner = await asyncio.start_server(flood, "127.0.0.1", 0)
        async with inner, Door("127.0.0.1", 0, inner.sockets[0].getsockname()[:2]) as door:
            viewer.connect(("127.0.0.1", door.port))
            viewer.sendall(b"GET / HTTP/1.1\r\n\r\n")
            before = -1
            while len(flooded) > before:  # until every buffer on the way is full
                before = len(flooded)
                await asyncio.sleep(0.1)

    flooded: list[int] = []
    with socket.socket() as viewer, warnings.catch_warnings(record=True) as left:
        warnings.simplefilter("always", ResourceWarning)
        asyncio.run(run())
        gc.collect()
    assert not [str(one.message) for one in left]


@pytest.mark.parametrize("turns", range(12))
def test_a_door_that_shuts_while_a_viewer_leaves_leaves_no_socket(turns: int) -> None:
    """`turns` of the loop are between both: one of them meets the door as it waits for what it passed on to end."""

    async def listen(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    async def run() -> None:
        inner = await asyncio.start_server(listen, "127.0.0.1", 0)
        async with inner, Door("127.0.0.1", 0, inner.sockets[0].getsockname()[:2]) as door:
            _, viewer = await asyncio.open_connection("127.0.0.1", door.port)
            viewer.write(b"GET / HTTP/1.1\r\n\r\n")
            await asyncio.sleep(0.05)
            viewer.close()
            await viewer.wait_closed()
            for _ in range(turns):
                await asyncio.sleep(0)

    with warnings.catch_warnings(record=True) as left:
        warnings.simplefilter("always", ResourceWarning)
        asyncio.run(run())
        gc.collect()
    assert not [str(one.message) for one in left]


def test_the_server_itself_hides_at_another_address_each_time() -> None:
    drawn = {hidden_address() for _ in range(50)}
    assert len(drawn) > 45
    assert all(ip_address(one).is_loopback for one in drawn)
