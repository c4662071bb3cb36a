"""What `cocoro status` tells of a robot that is up: the services that should run, their health, the task and the
planner's reason.

The supervisor is in the mesh and asks the services when a command asks it, through a socket in the robot's folder: to
join the mesh takes a command longer than all else. Without a supervisor the command joins and collects it, by the same
class.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import msgspec

from cocoro.bus.base import Bus
from cocoro.errors import CocoroError, ConfigError
from cocoro.messages import ClockOffset, Health, Message
from cocoro.participant import Participant
from cocoro.topics import ANY, BASE_STATE, HEALTH, LATCH, OFFSET, PLAN, RECORDING, TASK, Topic
from deploy import profiles, robot_time
from deploy.rundir import RunDir
from deploy.site.component import PREFIX

REPLAY, REPLAYED = "replay", "replayed"
"""Process that publishes a capture's messages, and the state of a service that it stands for."""
RECORDER = RECORDING.of("capture")
NEWS: tuple[Topic[Any], ...] = (PLAN, TASK, LATCH, BASE_STATE, RECORDER)
HEALTH_S = 2.5
"""Longest wait for the health of every live service; each publishes it once a second of the robot's time."""
AGAIN_S = 0.2
"""Period of asking for what was not published yet."""

log = logging.getLogger("deploy.supervisor")


class Onlooker(Participant):
    """A participant that only looks on, and knows the processes of this machine."""

    onlooker = True
    frame_depth = depth = 64

    def __init__(self, run_dir: RunDir, bus: Bus, private: bool = True) -> None:
        """`private`: only processes of this machine can be in this mesh."""
        super().__init__(bus, robot_time.clock(run_dir.path), run_dir.robot)
        self._private = private
        self.run_dir = run_dir
        self.robot = run_dir.robot

    def unheard(self, service: str) -> str:
        """The state of a service without a liveliness token: `replayed` when a replay publishes its messages, `not
        alive` when no process of this machine is it, else `no contact`, which a living process may be without."""
        by = self.run_dir.claimant(service)
        if by is not None and by.name == REPLAY:
            return REPLAYED
        return "not alive" if self._private and by is None else "no contact"

    def replayed(self) -> set[str]:
        """The services whose messages a replay of this machine publishes."""
        return {service for service, by in self.run_dir.claims().items() if by.name == REPLAY}


class Survey:
    """Collects the health of every live service and the newest state of task, plan, latch and base, once."""

    def __init__(self, onlooker: Onlooker, *, listens: bool = True) -> None:
        """`listens`: subscribe to all that too, for who would have to ask again for what was not published yet."""
        self._onlooker = onlooker
        self._listens = listens
        self._health: dict[str, Health] = {}
        self._newest: dict[str, Message] = {}
        self._offsets: dict[str, ClockOffset] = {}
        self._changed = asyncio.Event()
        if listens:
            onlooker.inbox(HEALTH.of("*")).add(lambda _key, health: self._on_health(health))
            for topic in NEWS:
                onlooker.inbox(topic).add(partial(self._on_news, topic.name))
            onlooker.on(OFFSET.of(ANY), self._on_offset)

    async def take(self, alive: set[str]) -> dict[str, Any]:
        """The report, once all services of `alive` have told their part, or the time for that is over."""
        there = alive | self._onlooker.replayed()
        wanted_news = {topic.name for topic in NEWS if topic.service in there}
        gateways = {name.removeprefix(PREFIX) for name in alive if name.startswith(PREFIX)}
        topics = (HEALTH.of("*"), *NEWS, *([OFFSET.of(ANY)] if gateways else []))
        asking = [asyncio.ensure_future(self._ask(topic)) for topic in topics]
        await within(
            HEALTH_S,
            lambda: there <= set(self._health) and wanted_news <= set(self._newest) and gateways <= set(self._offsets),
            self._changed,
        )
        for question in asking:
            question.cancel()
        await asyncio.gather(*asking, return_exceptions=True)
        return self._report(alive, there)

    async def _ask(self, topic: Topic[Any]) -> None:
        """Ask for messages that may not come of themselves for a second; one that came meanwhile is newer."""
        while True:
            for message in await self._onlooker.newest(topic, HEALTH_S):
                if isinstance(message, Health):
                    self._health.setdefault(message.service, message)
                elif isinstance(message, ClockOffset):
                    self._offsets.setdefault(message.host, message)
                else:
                    self._newest.setdefault(topic.name, message)
            self._changed.set()
            if self._listens:
                return
            await asyncio.sleep(AGAIN_S)

    def _on_health(self, health: Health) -> None:
        self._health[health.service] = health
        self._changed.set()

    def _on_offset(self, offset: ClockOffset) -> None:
        self._offsets[offset.host] = offset
        self._changed.set()

    def _on_news(self, topic: str, _key: str, message: Message) -> None:
        self._newest[topic] = message
        self._changed.set()

    def _report(self, alive: set[str], there: set[str]) -> dict[str, Any]:
        resolved = self._onlooker.run_dir.resolved()
        names = list(dict.fromkeys([*expected(resolved), *sorted(there)]))
        return {
            "robot": self._onlooker.robot,
            "profile": resolved.get("name", ""),
            "services": [
                {"service": name, "alive": name in alive, "state": self._state(name, name in alive, name in there)}
                | ({"health": msgspec.to_builtins(self._health[name])} if name in self._health else {})
                for name in names
            ],
            "clocks": [msgspec.to_builtins(self._offsets[host]) for host in sorted(self._offsets)],
            "task": self._newest_of(TASK),
            "plan": self._newest_of(PLAN),
            "latch": self._newest_of(LATCH),
            "base": self._newest_of(BASE_STATE),
            "recording": self._newest_of(RECORDER),
        }

    def _state(self, service: str, alive: bool, there: bool) -> str:
        if not alive:
            return self._onlooker.unheard(service)
        if service in self._health:
            return self._health[service].state
        return REPLAYED if there and service in self._onlooker.replayed() else "no report"

    def _newest_of(self, topic: Topic[Any]) -> Any:
        return msgspec.to_builtins(self._newest[topic.name]) if topic.name in self._newest else None


class SurveyServer:
    """Sends the report as JSON to each program that connects to `RunDir.survey_socket`, and closes the connection.

    The folder of the socket is this user's alone. Between the connections nothing is collected.
    """

    def __init__(self, onlooker: Onlooker) -> None:
        self._onlooker = onlooker
        self._alive: set[str] = set()
        self._server: asyncio.Server | None = None
        onlooker.watch_alive(lambda service, alive: (self._alive.add if alive else self._alive.discard)(service))

    async def open(self) -> None:
        """Begin to answer. Where that cannot be, the log says so, and commands ask the mesh."""
        try:
            self._server = await asyncio.start_unix_server(self._answer, self._onlooker.run_dir.survey_socket)
        except OSError as error:
            log.info("`cocoro status` is not answered by the supervisor: %s", error)

    def close(self) -> None:
        if self._server is not None:
            self._server.close()
            with suppress(OSError):
                self._onlooker.run_dir.survey_socket.unlink(missing_ok=True)
        self._onlooker.close()

    async def _answer(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            report = await Survey(self._onlooker, listens=False).take(set(self._alive))
            writer.write(msgspec.json.encode(report))
            await writer.drain()
        except (OSError, CocoroError) as error:
            log.info("`cocoro status` was not answered: %s", error)
        finally:
            writer.close()


def expected(resolved: dict[str, Any]) -> tuple[str, ...]:
    """Services that should be alive by `resolved`, the profile of the robot's last start."""
    try:
        return profiles.from_data(resolved, resolved.get("name", "")).services() if resolved else ()
    except ConfigError:  # a component has been uninstalled since
        return ()


async def within(timeout_s: float, condition: Callable[[], bool], changed: asyncio.Event) -> bool:
    """Waits until a condition holds, checking it whenever `changed` is set; returns whether it holds in the end."""
    try:
        async with asyncio.timeout(timeout_s):
            while not condition():
                changed.clear()
                await changed.wait()
    except TimeoutError:
        pass
    return condition()
