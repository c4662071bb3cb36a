"""What hostile clients of the cockpit cost a robot that drives: the period of its wheel commands, with and without.

Each kind of flood (`bench/cockpit_flood.py`) takes turns with as long a time without it, while the operator turns the
robot by hand from a page, 25 motions a second. Besides: for which share of the time it turned, how long the page waits
for an answer, and a STOP of the page while each kind floods. The clients have the lowest priority. As root, some of
them are another user's.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

from websockets.asyncio.client import ClientConnection, connect

from bench.cockpit_viewer import header_of
from bench.live import NAME, Operator, operator
from bench.report import Report, percentile
from bench.trials import number_of, sized
from cocoro.bus.base import Received
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CocoroError
from cocoro.topics import BASE_COMMAND
from deploy.rundir import RunDir

NOBODY = 65534
KINDS: dict[str, tuple[tuple[str, bool], ...]] = {
    "10,000 requests a second": (("requests", False),),
    "10,000 requests a second of another user": (("requests", True),),
    "new connections": (("connections", False),),
    "500 open sockets": (("silent", False),),
    "random bytes": (("rubbish", False),),
    "messages of 100 MB": (("frames", False),),
    "pings and tiny frames": (("pings", False),),
    "pages that read nothing": (("readers", False),),
    "all at once": tuple((kind, False) for kind in ("requests", "silent", "rubbish", "frames", "readers")),
}
"""The clients of each flood: kind, and whether they are another user's."""
BOUND = 1.5
ASKS_HZ = 20.0
TURN_RADPS, HOLD_HZ = 0.5, 25.0
PATIENCE_S = 60.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="turns of each kind (5)")
    parser.add_argument("--seconds", type=float, help="of each turn (6)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    count, seconds = sized(chosen, chosen.count, 5, 1), sized(chosen, chosen.seconds, 6.0, 3.0)
    with operator() as cocoro:
        code, said, _ = cocoro("up", "sim", "--detach", "--set", "service.cockpit.port=0")
        found = re.search(r"cockpit: http://127\.0\.0\.1:(\d+)/", said)
        if code or found is None:
            raise CocoroError(f"the robot with a cockpit did not start: {said}")
        asyncio.run(Bench(cocoro, int(found[1]), seconds, report).run(count))


class Turn(NamedTuple):
    """What was seen in one turn."""

    period_ms: float
    """99th percentile of the period of the commands for the wheels."""
    wait_ms: float
    """99th percentile of the page's waits for an answer."""
    moved: float
    """Percent of the states in which the robot turned."""


class Bench:
    def __init__(self, cocoro: Operator, port: int, seconds: float, report: Report) -> None:
        self._cocoro, self._port, self._seconds, self._report = cocoro, port, seconds, report
        self._arrived: list[int] = []

    async def run(self, count: int) -> None:
        async with await ZenohBus.open(self._cocoro.run_dir.join_as("bench"), expect_mesh=True) as bus:
            bus.listen(BASE_COMMAND.key(NAME), self._on_commands, 0.02)
            async with Page.opened(self._port) as page:
                for name, clients in KINDS.items():
                    async with page.turning():
                        await self._compare(name, clients, count, page)
                for name, clients in KINDS.items():
                    await self._stop(name, clients, page)

    def _on_commands(self, samples: list[Received]) -> None:
        self._arrived += [sample.received_ns for sample in samples]

    async def _compare(self, name: str, clients: tuple[tuple[str, bool], ...], count: int, page: Page) -> None:
        calm: list[Turn] = []
        flooded: list[Turn] = []
        spent: list[float] = []
        for _ in range(count):
            calm.append(await self._turn(page))
            with self._flooding(clients) as told:
                before_s, begun_s = self._spent_s(), time.monotonic()
                flooded.append(await self._turn(page))
                spent.append(100.0 * (self._spent_s() - before_s) / (time.monotonic() - begun_s))
            self._report.say(f"{name}: {told}")
        self._report.ratio(
            f"99th percentile of the commands' period, {name} / without",
            [turn.period_ms for turn in flooded], [turn.period_ms for turn in calm], at_most=BOUND,
        )  # fmt: skip
        waits = [turn.wait_ms for turn in flooded]
        self._report.value(f"99th percentile of a page's wait for an answer, {name}", waits, "ms")
        self._report.value(f"share of the time that it turned, {name}", [turn.moved for turn in flooded], "%")
        self._report.value(f"a core for the cockpit, {name}", spent, "%")

    async def _turn(self, page: Page) -> Turn:
        self._arrived.clear()
        page.moved.clear()
        waits = await page.waits_ms(self._seconds)
        periods = [(after - before) / 1e6 for before, after in pairwise(self._arrived)]
        if not periods or not page.moved:
            raise CocoroError("no command came for the wheels, or no state for the page")
        moved = 100.0 * sum(page.moved) / len(page.moved)
        return Turn(percentile(periods, 99), percentile(waits, 99), moved)

    @contextmanager
    def _flooding(self, clients: tuple[tuple[str, bool], ...], seconds: float | None = None) -> Iterator[list[str]]:
        told: list[str] = []
        processes = [self._client(kind, other, seconds or self._seconds + 1.0) for kind, other in clients]
        try:
            yield told
        finally:
            told += [process.communicate(timeout=PATIENCE_S)[0].strip() for process in processes]

    def _client(self, kind: str, other: bool, seconds: float) -> subprocess.Popen[str]:
        argv = [sys.executable, "-m", "bench.cockpit_flood", kind, str(self._port), str(seconds)]
        if other and os.geteuid() == 0:
            argv.append(str(NOBODY))
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        return process

    def _spent_s(self) -> float:
        """Processor time of the cockpit until now."""
        import psutil

        pid = RunDir(NAME, self._cocoro.run_dir.root).claimant_pid("cockpit")
        return sum(psutil.Process(pid).cpu_times()[:2])

    async def _stop(self, name: str, clients: tuple[tuple[str, bool], ...], page: Page) -> None:
        with self._flooding(clients, 4.0):
            await asyncio.sleep(2.0)
            begun_s = time.monotonic()
            reply = await page.ask({"do": "stop"})
            took_s = time.monotonic() - begun_s
        if not reply["ok"]:
            raise CocoroError(f"STOP of a page, {name}: {reply}")
        self._report.value(f"STOP of a page until all have acknowledged, {name}", [1e3 * took_s], "ms")
        await asyncio.to_thread(self._cocoro, "reset")


class Page:
    """A page of the operator with pictures: asks what lies at a place of the floor, again and again."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._numbers = itertools.count(1)
        self._tick = 0
        self.moved: list[bool] = []
        """Whether the robot turned, in each state that came."""
        self._news = asyncio.Event()

    @classmethod
    @asynccontextmanager
    async def opened(cls, port: int) -> AsyncIterator[Page]:
        async with connect(f"ws://127.0.0.1:{port}/live", max_size=None) as socket:
            page = cls(socket)
            hearing = asyncio.ensure_future(page._hear())
            try:
                yield page
            finally:
                hearing.cancel()

    async def _hear(self) -> None:
        async for text in self._socket:
            if isinstance(text, bytes):
                await self._socket.send(json.dumps({"do": "seen", "stamp_ns": header_of(text)["stamp_ns"]}))
                continue
            message = json.loads(text)
            if message["kind"] == "state":
                self.moved.append(abs((message.get("base") or {}).get("turn_radps") or 0.0) > TURN_RADPS / 4)
                self._news.set()
            elif message["kind"] == "tick":
                self._tick = message["tick"]
            elif message["kind"] == "reply" and (waiting := self._answers.pop(message["id"], None)) is not None:
                waiting.set_result(message)

    async def ask(self, order: dict[str, Any]) -> dict[str, Any]:
        number = next(self._numbers)
        waiting = self._answers[number] = asyncio.get_running_loop().create_future()
        await self._socket.send(json.dumps({**order, "id": number}))
        return await asyncio.wait_for(waiting, PATIENCE_S)

    async def waits_ms(self, seconds: float) -> list[float]:
        found, until_s = [], time.monotonic() + seconds
        while (begun_s := time.monotonic()) < until_s:
            await self.ask({"do": "what", "map": [1.0, 0.0]})
            found.append(1e3 * (time.monotonic() - begun_s))
            await asyncio.sleep(max(0.0, begun_s + 1.0 / ASKS_HZ - time.monotonic()))
        return found

    @asynccontextmanager
    async def turning(self) -> AsyncIterator[None]:
        """Turns the robot by hand. Raises CocoroError when it does not turn."""
        reply = await self.ask({"do": "begin-drive", "instead": True})
        if not reply["ok"]:
            raise CocoroError(f"the robot cannot be driven by hand: {reply['text']}")
        holding = asyncio.ensure_future(self._hold())
        try:
            async with asyncio.timeout(PATIENCE_S):
                while not any(self.moved):
                    self._news.clear()
                    await self._news.wait()
            yield
        except TimeoutError:
            raise CocoroError("the robot does not turn") from None
        finally:
            holding.cancel()
            self.moved.clear()
            await self.ask({"do": "end-drive"})

    async def _hold(self) -> None:
        while True:
            order = {"do": "drive", "tick": self._tick, "motion": {"turn_radps": TURN_RADPS}}
            await self._socket.send(json.dumps(order))
            await asyncio.sleep(1.0 / HOLD_HZ)
