"""Publishes a capture on a mesh again, all of it or the hardware's topics alone, under the recorded robot's name or
another one.

Readers reject a message that they have had from the same start of a publisher. So from the second pass on, each
message gets another incarnation, and so does every reference to a message: fields named `*incarnation`, and the
lists of a StepRecord. In the first pass payloads are sent unchanged.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from typing import Any

import msgspec

from cocoro.bus.base import Bus, Handle, Qos, RawPublisher
from cocoro.capture.former import todays_name, todays_payload
from cocoro.capture.player import Player
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import MADE_HERE, LossyFrame, NotReadableError
from cocoro.errors import ConfigError, RefusedError
from cocoro.keys import alive_key, service_of
from cocoro.messages import ClockTick
from cocoro.topics import ARM_STATE, BASE_STATE, CLOCK, FRAME, HAND_STATE, RECORDING
from deploy import processes
from services.capture.keys import KeyFilter

SIMULATOR = "sim"
HARDWARE_TOPICS = (FRAME, BASE_STATE, ARM_STATE, HAND_STATE)
"""The topics that a robot's hardware publishes."""
LINGER_S = 0.5
"""Pause after the last message: leaving the mesh discards what is not sent yet."""
TICK_S = 1 / 120
"""Period of the generated clock, for a capture without one."""


def played_keys(capture: Capture, only: Iterable[str], hardware: bool) -> frozenset[str]:
    """The keys of a capture that are played: all that components published, except what recorders published about
    themselves. Raises ConfigError when there is none."""
    robot = capture.robot
    recorders = {service_of(key) for key in capture.keys if key.endswith(RECORDING.name.partition("}")[2])}
    choice = KeyFilter(robot, only)
    keys = {
        key
        for key, channels in capture.keys.items()
        if key in choice
        and key.startswith(f"{robot}/")
        and service_of(key) not in recorders
        and any(capture.channels[channel].metadata.get("publisher") != MADE_HERE for channel in channels)
    }
    if hardware:
        keys &= {topic.key(robot) for topic in (*HARDWARE_TOPICS, CLOCK)}
    if not keys:
        raise ConfigError(f"{capture.path}: nothing to play: it has none of the selected keys")
    return frozenset(keys)


def services_of(keys: Iterable[str]) -> frozenset[str]:
    """The services that publish these keys."""
    return frozenset(service_of(key) for key in keys)


def heard_as(recorded: str, up: Mapping[str, Collection[str]]) -> str:
    """The name under which what the hardware published is heard: the recorded robot's, or that of the only robot that
    is up without hardware.

    `up` has the services of each robot that is up on this machine. Raises ConfigError when several could be meant.
    """
    simulated_or_real = {*processes.hardware(), SIMULATOR}
    listening = [name for name, services in up.items() if not simulated_or_real & set(services)]
    if recorded in up or not listening:
        return recorded
    if len(listening) > 1:
        choices = " or ".join(f"--robot {name}" for name in listening)
        raise ConfigError(
            f"the capture is of {recorded}, and {' and '.join(listening)} wait for hardware; choose one: {choices}"
        )
    return listening[0]


async def refuse_if_alive(bus: Bus, robot: str, services: frozenset[str]) -> None:
    """Raises RefusedError when a robot of this name is alive, or a service whose keys are to be played."""
    alive = {service_of(key) for key in await bus.alive(alive_key(robot))}
    hardware = sorted(alive & {*processes.hardware(), SIMULATOR})
    if hardware:
        raise RefusedError(
            f"a robot named {robot} is alive ({', '.join(hardware)}), and a replay would mix with its messages; "
            f"`cocoro down --robot {robot}` stops it"
        )
    if others := sorted(alive & services):
        raise RefusedError(
            f"{', '.join(others)} of {robot} is alive and publishes keys of this replay; "
            f"stop it, or leave these keys out with --only or --hardware"
        )


class Replay:
    """Plays on a bus until the capture ends. After each change of `player` from outside, call `changed`."""

    def __init__(
        self, bus: Bus, capture: Capture, player: Player, *, hardware: bool = False, robot: str | None = None
    ) -> None:
        """Publish what `player` plays of a capture. With `hardware` the hardware's services are declared alive, and
        there is always a clock. `robot` is the name under which messages are published; None: the recorded one."""
        self.sent = 0
        self._bus = bus
        self._capture = capture
        self._player = player
        self._hardware = hardware
        self._publishers: dict[str, RawPublisher] = {}
        self._handles: list[Handle] = []
        self._changed = asyncio.Event()
        self._robot = robot or capture.robot
        self._clock_key = CLOCK.key(capture.robot)
        self._ticks = 0
        self._incarnation = bus.new_incarnation()

    def changed(self) -> None:
        """The player was paused, moved or its rate was changed."""
        self._changed.set()

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        for key in self._player.keys:
            self._publisher(key)
        if self._hardware:
            self._handles += [self._bus.declare_alive(alive_key(self._robot, name)) for name in processes.hardware()]
        ticking = None
        if self._hardware and self._clock_key not in self._player.keys:
            ticking = asyncio.create_task(self._tick_for_ever())
        try:
            while True:
                passes = self._player.passes
                records = self._player.due(loop.time())
                if ticking is not None and self._player.passes != passes:
                    self._tick()  # the new epoch must begin before its messages
                for record in records:
                    self._send(record)
                if self._player.ended:
                    await asyncio.sleep(LINGER_S)
                    return
                await self._wait(self._player.wait_s(loop.time()))
        finally:
            if ticking is not None:
                ticking.cancel()
            for handle in (*self._handles, *self._publishers.values()):
                handle.close()

    async def _wait(self, seconds: float | None) -> None:
        self._changed.clear()
        if seconds == 0.0:
            await asyncio.sleep(0)
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._changed.wait()

    def _send(self, record: Record) -> None:
        payload = restarted(self._payload(record), self._player.passes)
        if record.key == self._clock_key:
            payload = with_rate(payload, self._player.rate)
        self._publisher(record.key).put(payload)
        self.sent += 1

    def _payload(self, record: Record) -> bytes | memoryview:
        """The payload as it was published; one of a former type in today's shape, a lossy frame expanded to a Frame."""
        schema = self._capture.schema(record.channel)
        if schema is None:
            return record.payload
        if schema.name != LossyFrame.__name__:
            return todays_payload(todays_name(schema.name), record.payload)
        try:
            return msgspec.msgpack.encode(self._capture.read(record))
        except NotReadableError:
            return record.payload

    def _publisher(self, key: str) -> RawPublisher:
        """The publisher for a recorded key. All keys are published as events, so that none is dropped under load."""
        publisher = self._publishers.get(key)
        if publisher is None:
            renamed = f"{self._robot}/{key.removeprefix(f'{self._capture.robot}/')}"
            publisher = self._publishers[key] = self._bus.publisher(renamed, Qos.EVENT)
        return publisher

    async def _tick_for_ever(self) -> None:
        while True:
            self._tick()
            await asyncio.sleep(TICK_S)

    def _tick(self) -> None:
        """Publish the clock. A real robot's capture has none; its stamps and its log times are both system time."""
        clock = ClockTick(
            stamp_ns=self._player.position_ns(asyncio.get_running_loop().time()),
            seq=self._ticks,
            incarnation=self._incarnation + (self._player.passes << 48),
            rate=self._player.rate,
            paused=self._player.paused,
        )
        self._ticks += 1
        self._publisher(self._clock_key).put(msgspec.msgpack.encode(clock))


_BITS = 48
"""Incarnations are random numbers of this many bits."""
_PARTS = ("consumed", "produced")


def restarted(payload: bytes | memoryview, passes: int) -> bytes | memoryview:
    """The payload with the incarnations of another start, for `passes` > 0. Anything but a MessagePack map stays as it
    is."""
    if passes == 0:
        return payload
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return payload
    return msgspec.msgpack.encode(_restarted(message, passes)) if isinstance(message, dict) else payload


def with_rate(payload: bytes | memoryview, rate: float) -> bytes | memoryview:
    """A ClockTick with its rate multiplied by `rate`."""
    if rate == 1.0:
        return payload
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return payload
    if not isinstance(message, dict) or not isinstance(message.get("rate"), int | float):
        return payload
    return msgspec.msgpack.encode({**message, "rate": message["rate"] * rate})


def _restarted(message: dict[Any, Any], passes: int) -> dict[Any, Any]:
    found: dict[Any, Any] = {}
    for name, value in message.items():
        if isinstance(name, str) and name.endswith("incarnation") and isinstance(value, int):
            found[name] = _next(value, passes)
        elif name in _PARTS and isinstance(value, list):
            found[name] = [_part(part, passes) for part in value]
        else:
            found[name] = value
    return found


def _part(part: Any, passes: int) -> Any:
    if isinstance(part, list) and len(part) == 3 and isinstance(part[1], int):
        return [part[0], _next(part[1], passes), part[2]]
    return part


def _next(incarnation: int, passes: int) -> int:
    return incarnation + (passes << _BITS)
