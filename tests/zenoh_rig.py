"""Child processes on a zenoh mesh that print what they receive, and ways to observe them."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from cocoro.bus import shared
from cocoro.bus.base import Payload
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus

PATIENCE_S = 60.0
FRAME = bytes(1_536_000)

CHILD = """
import asyncio, sys
from pathlib import Path
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus
from cocoro.bus.base import Qos

async def echo(key, payload):
    return NAME.encode()

def say(*words):
    print(*words, flush=True)

NAME = sys.argv[2]

async def join(**options):
    options = {"lease_s": 1.0, "shared_memory": True} | options
    return await ZenohBus.open(ZenohConfig(NAME, directory=Path(sys.argv[1]), **options))
"""

SERVICE = (
    CHILD
    + """
def tell(key, payload):
    say(key, bytes(payload[:8]).decode())

async def main():
    bus = await join()
    bus.subscribe("robot/frame", Qos.FRAME, tell, depth=1)
    bus.subscribe("robot/state", Qos.STATE, tell, depth=1)
    bus.serve(f"robot/{NAME}/who", echo)
    bus.declare_alive(f"robot/{NAME}/alive")
    say("ready")
    await asyncio.get_running_loop().create_future()
asyncio.run(main())
"""
)


PUBLISHER = (
    CHILD
    + """
from cocoro.bus import shared
async def main():
    async with await join(shared_memory=sys.argv[2] != "plain") as bus:
        if sys.argv[2] == "publisher":
            publisher = bus.publisher("robot/frame", Qos.FRAME)
            publisher.put(bytes(1_500_000))
            assert not publisher.trouble, publisher.trouble
        say("took", sum(shared.segments().values()))
        sys.stdin.readline()
        await bus.call("robot/*/who", b"", 0.1)
asyncio.run(main())
"""
)


class Child:
    """A process on the mesh that prints its activity, line by line."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    async def line(self) -> str:
        assert self.process.stdout is not None
        return (await self.process.stdout.readline()).decode().strip()

    async def says(self, wanted: str) -> None:
        while (line := await self.line()) != wanted:
            assert line, f"the child ended before it said {wanted!r}"

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    async def kill(self) -> None:
        if self.process.returncode is None:
            self.process.kill()
        await self.process.wait()


@asynccontextmanager
async def child(directory: Path, name: str, script: str = SERVICE) -> AsyncIterator[Child]:
    started = Child(
        await asyncio.create_subprocess_exec(sys.executable, "-c", script, str(directory), name, stdout=subprocess.PIPE)
    )
    try:
        yield started
    finally:
        await started.kill()


def scenario(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(asyncio.wait_for(test(**fixtures), PATIENCE_S))

    marked: Callable[..., None] = pytest.mark.zenoh(run)
    return marked


def local(directory: Path, name: str = "test", **options: Any) -> ZenohConfig:
    return ZenohConfig(name, directory=directory, **{"lease_s": 1.0, "shared_memory": True, **options})


@asynccontextmanager
async def changes(bus: ZenohBus, key: str) -> AsyncIterator[asyncio.Queue[bool]]:
    """A queue of the changes of a liveliness token: whether it exists."""
    news: asyncio.Queue[bool] = asyncio.Queue()
    watch = bus.watch_alive(key, lambda _, alive: news.put_nowait(alive))
    yield news
    watch.close()


async def appears(bus: ZenohBus, key: str) -> None:
    async with changes(bus, key) as news:
        assert await news.get()


async def who(bus: ZenohBus) -> list[str]:
    return sorted(reply.payload.decode() for reply in await bus.call("robot/*/who", b"", PATIENCE_S))


def left_in(directory: Path) -> list[str]:
    return [path.name for path in directory.iterdir()]


async def echo(key: str, payload: Payload) -> bytes:
    return bytes(payload)


def held() -> list[Path]:
    """The shared memory segments that this process holds; other processes' segments are not counted."""
    return [Path(f"/proc/self/fd/{fd}").readlink() for fd in shared._held()]
