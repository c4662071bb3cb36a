"""`cocoro view --foxglove`: a running robot in Foxglove, by a WebSocket server on this machine.

Everybody who reaches the server sees the robot and can stop it. Only with `--operate` it takes tasks, too, and then
only from programs of the same user on this machine: tasks are given in the name of who runs this command.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Coroutine
from contextlib import suppress
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from urllib.parse import urlencode

import msgspec

from apps.captures.export.files import making
from apps.captures.export.viewer import Attempt
from apps.cli import exits
from apps.cli.estop import by_path
from apps.cli.foxglove_door import Door, hidden_address
from apps.cli.interrupt import interrupt_event
from apps.cli.options import RobotChoice
from apps.cli.viewed import PER_SERVICE, Waiting, watch
from apps.client.link import MeshLink, joined, through_site
from cocoro.bus.base import Handle
from cocoro.errors import ConfigError, MeshError
from cocoro.keys import asker_key
from cocoro.messages import CancelRequest, EstopRequest, TaskRequest
from cocoro.topics import CANCEL, ESTOP, RUN, TOPICS
from deploy.processes import stoppable
from services.cockpit.access_peer import Peers
from services.executive.tasks import TASKS

if TYPE_CHECKING:
    from apps.captures.export.foxglove_server import FoxgloveServer

DEFAULT_PORT = 8765
"""Foxglove's own."""
FLUSH_S, LOOK_S = 10.0, 0.2
"""Longest wait for what is still to be shown at the end, and the period of looking for the end."""
ANSWER_S = 5.0
TRIES = 3
"""Requests to stop, on the mesh, while a service has not acknowledged."""
R = TypeVar("R")


class Place(NamedTuple):
    """Where the server listens, and what it takes."""

    bind: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    operate: bool = False
    layout: Path | None = None

    def check(self) -> None:
        """Raises ConfigError for tasks from other machines: nobody would know who asks."""
        with suppress(ValueError):
            if self.operate and not ip_address(self.bind).is_loopback:
                raise ConfigError(
                    f"--operate with --bind {self.bind}: everybody who reaches that address could drive the robot; "
                    "leave --bind out, and reach it through a tunnel, such as ssh -L 8765:127.0.0.1:8765"
                )


class Nothing(msgspec.Struct):
    """A question without fields."""


async def serve(choice: RobotChoice, place: Place) -> int:
    """Shows a robot's mesh in Foxglove until Ctrl-C.

    Raises CaptureError when foxglove-sdk is not installed, ConfigError when nobody can listen there, MeshError when
    there is no mesh.
    """
    place.check()
    from apps.captures.export.foxglove_layout import layout
    from apps.captures.export.foxglove_server import FoxgloveServer

    async with joined(choice, frames=True) as link:
        if place.layout is not None:
            with making(place.layout):
                place.layout.write_text(layout(link.robot), encoding="utf-8")
        asked = Asked(link, asyncio.get_running_loop(), local=through_site(choice) is None)
        topics = [topic for topic in TOPICS if PER_SERVICE not in topic.name]
        with FoxgloveServer(
            link.robot, await link.described(), link.catalogue(), topics,
            host=hidden_address(), port=0, services=asked.services(operate=place.operate),
        ) as server:  # fmt: skip
            peers = Peers()
            mine = peers.user if place.operate else None
            async with Door(place.bind, place.port, (server.host, server.port), mine) as door:
                address = address_of(place.bind, door.port)
                print(f"{link.robot} is at {address}: open {page_of(address)}")
                if place.layout is not None:
                    print(f"{place.layout}: import it there, under Layouts")
                if place.operate:
                    print("it takes tasks from every program of this user on this machine")
                print("Ctrl-C ends it", flush=True)
                await _show(link, server, asked)
    return exits.DONE


async def _show(link: MeshLink, server: FoxgloveServer, asked: Asked) -> None:
    """Give the server every message of the mesh, until Ctrl-C."""
    waiting = Waiting()
    watch(link.bus, link.robot, waiting)
    showing = Attempt(partial(waiting.log_to, server))
    try:
        with interrupt_event() as end:
            while not end.is_set() and not showing.join(0.0):
                with suppress(TimeoutError):
                    async with asyncio.timeout(LOOK_S):
                        await end.wait()
    finally:
        waiting.close()
        asked.close()
    if showing.join(FLUSH_S):
        showing.result()


def address_of(host: str, port: int) -> str:
    """Where a viewer connects to, `ws://...`."""
    return f"ws://{f'[{host}]' if ':' in host else host}:{port}"


def page_of(address: str) -> str:
    """The page of Foxglove that opens an address."""
    return f"https://app.foxglove.dev/?{urlencode({'ds': 'foxglove-websocket', 'ds.url': address})}"


class Asked:
    """What a viewer may ask for. Answers in the server's threads; the mesh is asked in the loop."""

    def __init__(self, link: MeshLink, loop: asyncio.AbstractEventLoop, *, local: bool) -> None:
        """`local`: the robot is on this machine, so that it can be stopped beside the mesh."""
        self._link = link
        self._loop = loop
        self._local = local
        self._token: Handle | None = None
        self._asker = f"operator-{link.bus.new_incarnation():x}"

    def services(self, *, operate: bool) -> list[Any]:
        """The stop; with `operate` also each task, and the end of a task."""
        from apps.captures.export.foxglove_layout import STOP
        from apps.captures.export.foxglove_server import Service

        found = [Service(STOP, Nothing, self.stop)]
        if operate:
            found += [
                Service(f"/task/{name}", kind, partial(self.run, name))
                for name, kind in TASKS.all().items()
                if kind.samples is None
            ]
            found.append(Service("/cancel", Nothing, self.cancel))
        return found

    def stop(self, _: dict[str, Any]) -> dict[str, Any]:
        """Latch the emergency stop: by the stop path of this machine, and by the mesh. Tells who acknowledged it."""
        acknowledged: set[str] = set()
        if self._local:
            stops, _troubles = by_path(self._link.robot)
            acknowledged.update(service for stop in stops for service in stop.acknowledged)
        alive = self._in_loop(self._link.alive())
        for _try in range(TRIES):
            for answer in self._in_loop(self._link.call_all(ESTOP.of("*"), EstopRequest(by="foxglove"))):
                if answer.reply is not None and answer.reply.latch == "latched":
                    acknowledged.add(answer.service)
            missing = [name for name in stoppable() if name in alive and name not in acknowledged]
            if not missing:
                break
        if not acknowledged & set(stoppable()):
            raise MeshError(f"nothing of {self._link.robot} that moves has acknowledged the stop")
        return {"acknowledged": sorted(acknowledged), "missing": missing}

    def run(self, name: str, given: dict[str, Any]) -> dict[str, Any]:
        """Start a task. It ends with this command, as any other task does with its own."""
        task = TASKS.read({**given, "task": name})
        return self._in_loop(self._begin(TaskRequest(task=task, asker=self._asker)))

    async def _begin(self, request: TaskRequest) -> dict[str, Any]:
        if self._token is None:
            self._token = self._link.bus.declare_alive(asker_key(self._link.robot, self._asker))
        answer: dict[str, Any] = msgspec.to_builtins(await self._link.call(RUN, request))
        return answer

    def cancel(self, _: dict[str, Any]) -> dict[str, Any]:
        """End the running task."""
        answer: dict[str, Any] = msgspec.to_builtins(self._in_loop(self._link.call(CANCEL, CancelRequest())))
        return answer

    def close(self) -> None:
        if self._token is not None:
            self._token.close()
            self._token = None

    def _in_loop(self, work: Coroutine[Any, Any, R]) -> R:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(ANSWER_S)
        except concurrent.futures.TimeoutError:
            future.cancel()
            raise MeshError(f"no answer of {self._link.robot} within {ANSWER_S:g} s") from None
