"""The cockpit's door and gate over real sockets: what hostile connections meet, and that others are served then."""

from __future__ import annotations

import asyncio
import os
import random
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from functools import wraps
from typing import Any

import pytest
from cockpit_access_rig import Open, served
from websockets.asyncio.client import connect

from services.cockpit.access import GateLimits
from services.cockpit.access_limits import DoorLimits, Rate
from services.cockpit.access_peer import Peers

LIMIT_S = 60.0
PLENTY = Rate(1e6, 1e6)
QUICK = DoorLimits(first_s=0.6, idle_s=0.6, stalled_s=0.6, overfed_s=0.6, takes=PLENTY, takes_all=PLENTY)
"""Limits that a test need not wait for."""
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")


def in_real_time(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Runs a test that is a coroutine on real sockets."""

    @wraps(test)
    def run(*given: Any, **named: Any) -> None:
        asyncio.run(asyncio.wait_for(test(*given, **named), LIMIT_S))

    return run


async def until(what: Callable[[], object]) -> None:
    """Waits until something is so; the test's own limit ends a wait in vain."""
    while not what():  # noqa: ASYNC110 # what is waited for tells nobody
        await asyncio.sleep(0.01)


class Client:
    """A connection that writes what it likes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def to(cls, cockpit: Open) -> Client:
        return cls(*await asyncio.open_connection("127.0.0.1", cockpit.port))

    async def rest(self) -> bytes:
        """All that comes until the other side ends the connection."""
        found = b""
        try:
            while data := await self.reader.read(65536):
                found += data
        except ConnectionError:
            pass
        finally:  # also when the call is cancelled, or the other side refuses it in TLS
            self.writer.transport.abort()
        return found

    async def __call__(self, data: bytes) -> bytes:
        self.writer.write(data)
        return await self.rest()


@asynccontextmanager
async def silent(cockpit: Open, count: int) -> AsyncIterator[None]:
    """So many connections that ask nothing."""
    writers: list[asyncio.StreamWriter] = []
    try:
        for _ in range(count):
            writers.append((await asyncio.open_connection("127.0.0.1", cockpit.port))[1])  # noqa: PERF401 # may fail
        yield
    finally:
        for writer in writers:
            writer.transport.abort()


def request(cockpit: Open, path: str = "/", method: str = "GET", more: str = "") -> bytes:
    return f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{cockpit.port}\r\n{more}\r\n".encode()


async def is_served(cockpit: Open) -> bool:
    """Whether somebody else is served now."""
    return (await (await Client.to(cockpit))(request(cockpit, more="Connection: close\r\n"))).startswith(
        b"HTTP/1.1 200"
    )


RUBBISH = {
    "random bytes": random.Random(1).randbytes(2000),
    "TLS to a port without": bytes.fromhex("16030100a5010000a10303") + bytes(160),
    "HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "SSH": b"SSH-2.0-OpenSSH_9.7\r\n",
    "zenoh": struct.pack("<H", 40) + bytes(40),
    "no request line": b"\r\n" * 3000,
    "an endless request line": b"GET /" + b"a" * 40_000,
    "an endless header": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"a" * 40_000,
    "endless headers": b"GET / HTTP/1.1\r\n" + b"X: a\r\n" * 8000,
    "two lengths": b"POST /stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
    "a folded header": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n X: a\r\n\r\n",
    "a NUL in a header": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: a\0b\r\n\r\n",
}


@pytest.mark.parametrize("what", RUBBISH)
@in_real_time
async def test_rubbish_is_ended_and_logged_and_others_are_served(what: str) -> None:
    async with served(door_limits=QUICK) as cockpit:
        answer = await (await Client.to(cockpit))(RUBBISH[what])
        assert not answer or answer.startswith((b"HTTP/1.1 400", b"HTTP/1.1 421"))
        await until(lambda: cockpit.audit.refusals)
        assert await is_served(cockpit)
        assert not cockpit.echo.asked[1:]


SMUGGLED = {
    "length and chunks": "Content-Length: 4\r\nTransfer-Encoding: chunked\r\n",
    "two encodings": "Transfer-Encoding: gzip, chunked\r\n",
    "a length with a sign": "Content-Length: +4\r\n",
}


@pytest.mark.parametrize("what", SMUGGLED)
@in_real_time
async def test_a_request_with_two_readings_hides_no_second_one(what: str) -> None:
    async with served(door_limits=QUICK) as cockpit:
        hidden = request(cockpit, "/hidden")
        client = await Client.to(cockpit)
        await client(request(cockpit, "/captures/clean", "POST", SMUGGLED[what]) + b"0\r\n\r\n" + hidden)
        assert not [path for path in cockpit.echo.asked if "hidden" in path]


@in_real_time
async def test_silent_and_half_open_connections_are_ended() -> None:
    async with served(door_limits=QUICK) as cockpit:
        silent, half, dribbling = [await Client.to(cockpit) for _ in range(3)]
        half.writer.write(b"GET / HTTP/1.1\r\nHost: 127")

        async def dribble() -> None:
            while not dribbling.writer.is_closing():
                dribbling.writer.write(b"a")
                await asyncio.sleep(0.02)

        slow = asyncio.ensure_future(dribble())
        assert [await each.rest() for each in (silent, half, dribbling)] == [b"", b"", b""]
        slow.cancel()
        assert cockpit.audit.has("it asks nothing")


@in_real_time
async def test_a_connection_that_asks_no_more_is_ended() -> None:
    async with served(door_limits=QUICK) as cockpit:
        client = await Client.to(cockpit)
        client.writer.write(request(cockpit))
        assert (await client.reader.readuntil(b"\r\n")).startswith(b"HTTP/1.1 200")
        client.writer.write(b"GET / HT")  # a second request that never ends
        await client.rest()
        assert not cockpit.taken()


@in_real_time
async def test_five_hundred_silent_sockets_keep_nobody_out() -> None:
    limits = QUICK._replace(first_s=60.0)
    async with served(door_limits=limits) as cockpit, silent(cockpit, 500):
        assert len(cockpit.taken()) <= limits.each
        assert await is_served(cockpit)
        assert cockpit.audit.has("ended to make room")


@in_real_time
async def test_sockets_that_are_served_are_not_ended_for_newcomers() -> None:
    async with served(door_limits=QUICK._replace(first_s=60.0, each=4)) as cockpit:
        url = f"ws://127.0.0.1:{cockpit.port}/live"
        async with connect(url) as one, connect(url) as other, silent(cockpit, 50):
            for page in (one, other):
                await page.send("still here")
                assert await page.recv() == "still here"


@in_real_time
async def test_new_connections_beyond_the_rate_are_refused_and_pages_are_served() -> None:
    limits = QUICK._replace(takes=Rate(1e-6, 10.0))
    async with served(door_limits=limits) as cockpit, connect(f"ws://127.0.0.1:{cockpit.port}/live") as page:
        for _ in range(200):
            async with silent(cockpit, 1):
                pass
        await until(lambda: cockpit.audit.refusals >= 191)
        assert cockpit.audit.has("too many in a second")
        await page.send("still here")
        assert await page.recv() == "still here"


@in_real_time
async def test_a_reader_that_takes_nothing_is_ended() -> None:
    async with served(door_limits=QUICK) as cockpit:
        with socket.socket() as page:
            page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            page.setblocking(False)
            loop = asyncio.get_running_loop()
            await loop.sock_connect(page, ("127.0.0.1", cockpit.port))
            await loop.sock_sendall(page, upgrade(cockpit))
            for _ in range(30):
                text = b"send 1000000"
                await loop.sock_sendall(page, bytes([0x81, 0x80 | len(text)]) + bytes(4) + text)
            await until(lambda: cockpit.audit.has("it takes nothing"))
            await until(lambda: not cockpit.taken())


@in_real_time
async def test_a_client_that_sends_without_end_is_read_slowly_and_ended() -> None:
    limits = QUICK._replace(bytes=Rate(4096.0, 16384.0), stalled_s=60.0)
    async with served(door_limits=limits) as cockpit:
        client = await Client.to(cockpit)
        await open_page(cockpit, client)
        ping = bytes([0x89, 0x84]) + bytes(8)
        with suppress(ConnectionError):
            while not client.reader.at_eof():
                client.writer.write(ping * 100)
                await asyncio.wait([asyncio.ensure_future(client.writer.drain())], timeout=0.05)
                await client.reader.read(65536)
        await until(lambda: cockpit.audit.has("it sends too much"))


async def open_page(cockpit: Open, client: Client) -> None:
    """Opens a socket on a connection."""
    client.writer.write(upgrade(cockpit))
    assert b" 101 " in await client.reader.readuntil(b"\r\n\r\n")


def upgrade(cockpit: Open) -> bytes:
    """The request that opens a socket."""
    more = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    return request(cockpit, "/live", more=f"{more}Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n")


FRAMES = {
    "longer than allowed": bytes([0x82, 0xFF]) + struct.pack("!Q", 10**12) + bytes(4),
    "longer than anything": bytes([0x82, 0xFF]) + b"\xff" * 8 + bytes(4),
    "not masked": bytes([0x81, 0x05]) + b"hello",
    "reserved bits": bytes([0xF1, 0x81]) + bytes(4) + b"x",
    "an unknown opcode": bytes([0x83, 0x80]) + bytes(4),
    "a long ping": bytes([0x89, 0xFE]) + struct.pack("!H", 200) + bytes(204),
    "a continuation of nothing": bytes([0x80, 0x81]) + bytes(4) + b"x",
    "no UTF-8": bytes([0x81, 0x82]) + bytes(4) + b"\xc3\x28",
    "a close without a code": bytes([0x88, 0x81]) + bytes(4) + b"\x03",
    "a text in endless pieces": bytes([0x01, 0xFE]) + struct.pack("!H", 60000) + bytes(4) + b"x" * 60000
    + bytes([0x00, 0xFE]) + struct.pack("!H", 60000) + bytes(4) + b"x" * 60000,
    "binary": bytes([0x82, 0x82]) + bytes(4) + b"\0\1",
    "random": random.Random(2).randbytes(4000),
}  # fmt: skip


@pytest.mark.parametrize("what", FRAMES)
@in_real_time
async def test_a_malformed_frame_ends_its_socket_with_a_reason(what: str) -> None:
    async with served(door_limits=QUICK) as cockpit:
        client = await Client.to(cockpit)
        await open_page(cockpit, client)
        answer = await client(FRAMES[what])
        assert answer[:1] == b"\x88", answer[:80]  # a close frame, and nothing before it
        assert struct.unpack("!H", answer[2:4])[0] in (1002, 1003, 1007, 1009)
        assert not cockpit.echo.messages
        await until(lambda: not cockpit.taken())
        assert await is_served(cockpit)


@in_real_time
async def test_a_flood_of_requests_is_refused_and_a_page_is_served() -> None:
    limits = GateLimits(requests=Rate(1e-6, 30.0))
    async with served(door_limits=QUICK, gate_limits=limits) as cockpit:
        async with connect(f"ws://127.0.0.1:{cockpit.port}/live") as page:
            for _ in range(10):
                client = await Client.to(cockpit)
                answers = await client(request(cockpit) * 20)
            assert b"429" in answers
            await page.send("still here")
            assert await page.recv() == "still here"
        assert len(cockpit.echo.asked) == 29
        assert cockpit.audit.has("too many requests")


@in_real_time
async def test_a_client_that_says_to_be_another_is_not_believed() -> None:
    async with served(door_limits=QUICK) as cockpit:
        answer = await (await Client.to(cockpit))(request(cockpit, more="X-Forwarded-For: 10.0.0.5\r\n"))
        assert answer.startswith(b"HTTP/1.1 403")
        assert cockpit.audit.has("proxy")


@in_real_time
async def test_this_machines_user_is_an_operator_and_named() -> None:
    async with served(door_limits=QUICK) as cockpit:
        answer = await (await Client.to(cockpit))(request(cockpit, "/run", "POST", "Connection: close\r\n"))
        assert answer.startswith(b"HTTP/1.1 200")


def as_nobody(work: Callable[[], bytes]) -> Awaitable[bytes]:
    """Does something as another user, in a process of its own; what it returned."""
    "localhost".encode("idna")  # loads the codec, whose file the other user may not read

    def child() -> bytes:
        read, write = os.pipe()
        number = os.fork()
        if not number:
            try:
                os.setgid(65534)
                os.setuid(65534)
                os.write(write, work())
            finally:
                os._exit(0)
        os.close(write)
        with os.fdopen(read, "rb") as file:
            said = file.read()
        os.waitpid(number, 0)
        return said

    return asyncio.to_thread(child)


@needs_root
@pytest.mark.process
@in_real_time
async def test_a_process_of_another_user_is_turned_away() -> None:
    async with served(door_limits=QUICK) as cockpit:
        asked = request(cockpit, "/run", "POST")

        def ask() -> bytes:
            with socket.create_connection(("127.0.0.1", cockpit.port)) as client:
                client.sendall(asked)
                return client.recv(1000)

        assert b"another user's" in await as_nobody(ask)
        assert cockpit.audit.has("user 65534", "another user's process")
        assert not cockpit.echo.asked


@needs_root
@pytest.mark.process
@in_real_time
async def test_a_process_of_another_user_that_has_gone_is_not_taken_for_root() -> None:
    """The kernel says user 0 of a socket that its process has closed."""
    async with served(door_limits=QUICK) as cockpit:
        asked = request(cockpit, "/run", "POST")

        def ask() -> bytes:
            with socket.create_connection(("127.0.0.1", cockpit.port)) as client:
                client.sendall(asked)
            return b"gone"

        cockpit.door.hold_newcomers()
        assert await as_nobody(ask) == b"gone"
        cockpit.door.take_newcomers()
        await until(lambda: cockpit.audit.has("nobody", "its process has gone"))
        assert not cockpit.echo.asked


@in_real_time
async def test_the_kernel_and_its_tables_agree_on_whose_a_connection_is() -> None:
    from services.cockpit.access_peer import _listed

    peers = Peers()
    for host in ("127.0.0.1", "::1"):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with (
            socket.create_server((host, 0), family=family) as listener,
            socket.create_connection(listener.getsockname()[:2]) as client,
            listener.accept()[0] as taken,
        ):
            ends = taken.getpeername()[:2], taken.getsockname()[:2]
            assert peers.user(*ends) == _listed(*ends) == os.getuid()
            client.close()
            assert peers.user(*ends) is _listed(*ends) is None
    peers.close()
