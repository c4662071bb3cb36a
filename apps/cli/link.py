"""The operator's way into a robot's mesh: calls, streams and liveliness, without being a service of its own."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import msgspec

from apps.cli.options import RobotChoice
from cocoro.bus.base import Bus, Handle, Reply
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CallTimeoutError, ConfigError, MeshError, RemoteError
from cocoro.inbox import Inbox, Latest, Stream
from cocoro.messages import Message
from cocoro.topics import Request, Topic
from deploy import robot_time
from deploy.rundir import RunDir, robots

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)

START = "start one with `cocoro up sim`"


class Answer(NamedTuple, Generic[R]):
    """What one service answered to a request that went to several."""

    service: str
    reply: R | None
    error: str


class Link:
    """Make it with `joined`."""

    def __init__(self, run_dir: RunDir, bus: Bus, private: bool = True) -> None:
        """`private`: all who can be in this mesh are processes of this machine."""
        self._private = private
        self.run_dir = run_dir
        self.robot = run_dir.robot
        self.bus = bus
        self._clock = robot_time.clock(run_dir.path)

    async def call(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> R:
        """Raises MeshError when nobody serves it or answers in time, RemoteError with the server's words."""
        replies = await self._ask(request, question, timeout_s)
        if not replies:
            raise MeshError(f"{self.robot} has no {request.server} running: {START}, `cocoro status` tells more")
        answer = _understood(request, replies[0])
        if answer.reply is None:
            raise RemoteError(f"{answer.service}: {answer.error}")
        return answer.reply

    async def call_all(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> list[Answer[R]]:
        """All answers, errors among them; none when nobody answers in time."""
        try:
            return [_understood(request, reply) for reply in await self._ask(request, question, timeout_s)]
        except CallTimeoutError:
            return []

    async def _ask(self, request: Request[Q, R], question: Q, timeout_s: float | None) -> list[Reply]:
        wait_s = request.timeout_s if timeout_s is None else timeout_s
        return await self.bus.call(request.key(self.robot), msgspec.msgpack.encode(question), wait_s)

    def stream(self, topic: Topic[M]) -> Stream[M]:
        return Stream(self.inbox(topic))

    def latest(self, topic: Topic[M]) -> Latest[M]:
        return Latest(self.inbox(topic), self._clock)

    def inbox(self, topic: Topic[M]) -> Inbox[M]:
        """Everything that arrives on a topic from now on; `close` its subscription to end that."""
        inbox = Inbox(topic, topic.key(self.robot), self._clock, onlooker=True)
        inbox.subscription = self.bus.subscribe(inbox.keyexpr, topic.qos, inbox.deliver, depth=64)
        return inbox

    async def alive(self) -> list[str]:
        """The services that live now."""
        return sorted(key.split("/")[1] for key in await self.bus.alive(f"{self.robot}/*/alive"))

    def unheard(self, service: str) -> str:
        """What is true of a service whose token is not there, as a state: `no contact` with it, which its process may
        live without, or `not alive`, when no process of this machine is it."""
        return "not alive" if self._private and self.run_dir.claimant(service) is None else "no contact"

    def watch_alive(self, service: str, handler: Callable[[bool], None]) -> Handle:
        return self.bus.watch_alive(f"{self.robot}/{service}/alive", lambda _key, alive: handler(alive))


def _understood(request: Request[Q, R], reply: Reply) -> Answer[R]:
    service = reply.key.split("/")[1] if reply.key.count("/") else request.server
    if not reply.ok:
        return Answer(service, None, reply.payload.decode(errors="replace"))
    try:
        return Answer(service, msgspec.msgpack.decode(reply.payload, type=request.reply), "")
    except msgspec.MsgspecError as error:
        return Answer(service, None, f"answered something that is no {request.reply.__name__}: {error}")


def find(where: RobotChoice) -> RunDir:
    """The robot that is meant. Raises MeshError when none is up, ConfigError when it is not clear which."""
    if where.robot is not None:
        return RunDir(where.robot)
    up = robots()
    if not up:
        raise MeshError(f"no robot is up on this machine: {START}")
    if len(up) > 1:
        raise ConfigError(f"several robots are up, say which: {', '.join(f'--robot {r.robot}' for r in up)}")
    return up[0]


@asynccontextmanager
async def joined(where: RobotChoice, patience_s: float | None = None, *, frames: bool = False) -> AsyncIterator[Link]:
    """Join the mesh of a robot. Raises MeshError when it is not there. `frames`: it is to read them, or everything."""
    if where.profile is not None:
        from deploy import profiles

        profile = profiles.read(where.profile)
        run_dir = RunDir(where.robot or profile.robot)
        config = run_dir.join_as("operator", profile.mesh)
    else:
        run_dir = find(where)
        config = run_dir.join_as("operator")
        if config.directory is not None and not run_dir.populated:
            raise MeshError(f"{run_dir.robot} is not up on this machine: {START}")
    config = replace(config, shared_memory=frames)
    if patience_s is not None:
        config = replace(config, patience_s=patience_s)
    async with await ZenohBus.open(config, expect_mesh=True) as bus:
        yield Link(run_dir, bus, private=config.directory is not None)


async def within(timeout_s: float, condition: Callable[[], bool], changed: asyncio.Event) -> bool:
    """Wait until a condition holds, looking whenever `changed` is set; False when it does not in time."""
    try:
        async with asyncio.timeout(timeout_s):
            while not condition():
                changed.clear()
                await changed.wait()
    except TimeoutError:
        pass
    return condition()
