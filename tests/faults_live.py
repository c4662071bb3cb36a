"""A live simulated robot and an observer on its mesh, for tests that kill and stop its processes. All times are the
simulator's stamps."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from itertools import pairwise
from math import hypot
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from operator_shell import PATIENCE_S, Running
from places import short_folder
from spelled import asked

from cocoro import topics
from cocoro.bus.base import Payload, Qos
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS
from cocoro.messages import AboutRequest, Exchange, Message, TaskReply, TaskRequest, TaskState, Truth
from cocoro.topics import Topic
from deploy.processes import hardware
from deploy.rundir import RunDir, Target

M = TypeVar("M", bound=Message)

SERVICES = (*hardware(), "perception", "planning", "executive")
WATCHED: tuple[Topic[Any], ...] = (
    topics.TRUTH, topics.BASE_STATE, topics.BASE_COMMAND, topics.INTENT, topics.DETECTIONS, topics.PLAN, topics.TASK,
    topics.EXCHANGES.of("base"), *(topics.HEALTH.of(service) for service in SERVICES),
)  # fmt: skip
KEEP = 1_000_000
"""Depth of the observer's queues: it loses nothing, even when it is late."""
SLOW = {"width": 320, "height": 240, "frame_rate_hz": 30.0, "pace": 0.5}
"""Small images and a reduced frame rate, so that load does not make the robot late."""
SHORT_LEASE = "[mesh]\nlease_s = 1.0\n"
PROCESSES = ("sim", "perception", "planning", "executive")
STANDING_MPS = 0.01


class LiveRobot:
    """A running robot, made by `live`."""

    def __init__(self, name: str, root: Path, folder: Path) -> None:
        self.name = name
        self.run_dir = RunDir(name, root)
        self.profile = folder / f"{name}.toml"
        self.up: Running
        self._root = root
        self._bus: ZenohBus
        self._heard: dict[str, list[Message]] = defaultdict(list)
        self._alive: dict[str, bool] = {}
        self._news = asyncio.Event()

    # --- up and down ----------------------------------------------------------------------------------

    async def start(self) -> None:
        self.up = Running([sys.executable, "-m", "apps.cli.main", "up", str(self.profile)], self.env)
        await self.told("is up")
        self._bus = await ZenohBus.open(self.run_dir.join_as("onlooker"))
        for topic in WATCHED:
            self._bus.subscribe(topic.key(self.name), Qos.STATE, self._stored(topic), depth=KEEP)
        self._bus.watch_alive(f"{self.name}/*/alive", self._on_alive)
        await self.until(lambda: self.heard(topics.TRUTH))

    async def stop(self) -> None:
        if hasattr(self, "_bus"):
            await self._bus.close()
        for service in list(self.run_dir.claims()):
            self.signal(service, signal.SIGCONT)
        if self.up.process.poll() is None:
            await asyncio.to_thread(self.up.end, signal.SIGINT)

    @property
    def env(self) -> dict[str, str]:
        return os.environ | {"COCORO_RUN_DIR": str(self._root)}

    async def told(self, text: str) -> str:
        """Wait for a line of the supervisor's output."""
        return await asyncio.to_thread(self.up.until, text)

    async def command(self, *arguments: str) -> tuple[int, str]:
        """Run a `cocoro` command; returns its exit code and output."""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "apps.cli.main", *arguments, "--robot", self.name,
            env=self.env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        out, _ = await asyncio.wait_for(process.communicate(), PATIENCE_S)
        assert process.returncode is not None
        return process.returncode, out.decode()

    def pid(self, service: str) -> int:
        return self.run_dir.claims()[service].pid

    def signal(self, service: str, number: signal.Signals) -> None:
        """Send a signal to the current process of a service."""
        target = Target(self.run_dir.path / "claims" / service)
        target.signal(number)
        target.close()

    # --- messages -------------------------------------------------------------------------------------

    def _stored(self, topic: Topic[Any]) -> Callable[[str, Payload], None]:
        decoder = msgspec.msgpack.Decoder(topic.type)

        def keep(_key: str, payload: Payload) -> None:
            with suppress(msgspec.MsgspecError):  # the publisher of invalid messages in a test
                self._heard[topic.name].append(decoder.decode(payload))
                self._news.set()

        return keep

    def _on_alive(self, key: str, alive: bool) -> None:
        self._alive[key.split("/")[1]] = alive
        self._news.set()

    def alive(self, *services: str) -> bool:
        return all(self._alive.get(service, False) for service in services)

    def heard(self, topic: Topic[M]) -> list[M]:
        """All messages of a topic, in order of arrival."""
        return self._heard[topic.name]  # type: ignore[return-value]

    def forget(self) -> None:
        self._heard.clear()

    async def until(self, content: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
        """Wait until a condition holds; checks it at every received message."""
        async with asyncio.timeout(timeout_s):
            while not content():
                self._news.clear()
                await self._news.wait()

    @property
    def now_s(self) -> float:
        """The newest received simulated time."""
        truths = self.heard(topics.TRUTH)
        return truths[-1].stamp_ns / NS if truths else 0.0

    async def passes(self, seconds: float) -> None:
        """Wait for simulated time."""
        end_s = self.now_s + seconds
        await self.until(lambda: self.now_s >= end_s)

    async def surely_now_s(self) -> float:
        """Wait for a simulated time that is not earlier than the call."""
        exchanges = topics.EXCHANGES.of("base")
        before = len(self.heard(exchanges))
        key = topics.ABOUT.of("base").key(self.name)
        await self._bus.call(key, msgspec.msgpack.encode(AboutRequest()), PATIENCE_S)
        await self.until(lambda: len(self.heard(exchanges)) > before)
        newest: Exchange = self.heard(exchanges)[-1]
        return newest.stamp_ns / NS

    def publish(self, key: str, payload: bytes) -> None:
        """Publish a payload under this robot's name."""
        publisher = self._bus.publisher(f"{self.name}/{key}", Qos.STATE)
        publisher.put(payload)
        publisher.close()

    # --- tasks ----------------------------------------------------------------------------------------

    async def ask(self, request: TaskRequest) -> TaskReply:
        key = topics.RUN.key(self.name)
        replies = await self._bus.call(key, msgspec.msgpack.encode(request), PATIENCE_S)
        if not replies:
            return TaskReply(accepted=False, refusal="not_alive", text="nobody answers")
        assert replies[0].ok, replies[0].payload
        return msgspec.msgpack.decode(replies[0].payload, type=TaskReply)

    async def begin(self, request: TaskRequest) -> str:
        """Request a task until it is accepted; returns its id."""
        async with asyncio.timeout(PATIENCE_S):
            while not (reply := await self.ask(request)).accepted:
                assert reply.refusal in ("not_alive", "estop"), reply.text
                await self.passes(0.1)
        return reply.task_id

    def state(self, task_id: str) -> TaskState | None:
        return next((state for state in reversed(self.heard(topics.TASK)) if state.task_id == task_id), None)

    async def outcome(self, task_id: str) -> TaskState:
        def ended() -> bool:
            state = self.state(task_id)
            return state is not None and state.outcome is not None

        await self.until(ended, PATIENCE_S)
        state = self.state(task_id)
        assert state is not None
        return state

    async def driving(self, label: str = "red_can", speed_mps: float = 0.12) -> str:
        """Start a fetch and wait until the robot drives; returns the task's id."""
        task_id = await self.begin(asked("fetch", label=label))
        await self.drives(speed_mps, task_id)
        return task_id

    async def drives(self, speed_mps: float = 0.12, task_id: str = "") -> None:
        """Wait until the body moves, by the true state."""
        since_s = self.now_s

        def fast() -> bool:
            if task_id and (state := self.state(task_id)) is not None:
                assert state.outcome is None, state.reason
            speeds = self.speeds(since_s)
            return bool(speeds) and speeds[-1] > speed_mps

        await self.until(fast)

    # --- the truth ------------------------------------------------------------------------------------

    def speeds(self, since_s: float) -> list[float]:
        """True speeds of the body, one for each later step of the true state."""
        after = [truth for truth in self.heard(topics.TRUTH) if truth.stamp_ns >= since_s * NS]
        return [_speed_mps(a, b) for a, b in pairwise(after)]

    def stood_since(self, when_s: float) -> bool:
        return max(self.speeds(when_s)) < STANDING_MPS

    def obeyed_since(self, when_s: float) -> list[tuple[float, float]]:
        """Later wheel commands other than zero."""
        return [
            (command.ahead_mps, command.turn_radps)
            for command in self.heard(topics.BASE_COMMAND)
            if command.stamp_ns > when_s * NS and (command.ahead_mps or command.turn_radps)
        ]

    def held(self, label: str) -> bool:
        """Whether an object touches both claws and nothing else, by the true state."""
        objects = self.heard(topics.TRUTH)[-1].objects
        return set(next(item for item in objects if item.label == label).touching) == {"claw_left", "claw_right"}


def _speed_mps(a: Truth, b: Truth) -> float:
    return hypot(b.body_m[0] - a.body_m[0], b.body_m[1] - a.body_m[1]) / ((b.stamp_ns - a.stamp_ns) / NS)


@asynccontextmanager
async def live(
    folder: Path,
    *,
    name: str = "calliope",
    scene: Path | str = "paper",
    mesh: str = "",
    processes: Sequence[str] = PROCESSES,
    **sim: Any,
) -> AsyncIterator[LiveRobot]:
    """Start a robot and shut it down at the end. `sim`: settings of the simulator besides `SLOW`."""
    root = short_folder()
    robot = LiveRobot(name, root, folder)
    robot.profile.write_text(profile_text(name, {**SLOW, "scene": str(scene), **sim}, mesh, processes))
    try:
        await robot.start()
        yield robot
    finally:
        await robot.stop()
        shutil.rmtree(root)


def profile_text(name: str, sim: Mapping[str, Any], mesh: str = "", processes: Sequence[str] = PROCESSES) -> str:
    settings = "".join(f"{key} = {json.dumps(value)}\n" for key, value in sim.items())
    return f'robot = "{name}"\nclock = "sim"\nprocesses = {json.dumps(processes)}\n{mesh}\n[service.sim]\n{settings}'
