"""A capture sent into a mesh again, as it was or as the robot's hardware alone."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import msgspec

from apps.captures.player import Player
from cocoro.bus.base import Bus, Handle, Qos, RawPublisher
from cocoro.capture.former import todays_name, todays_payload
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
"""What a robot's hardware says."""
LINGER_S = 0.5
"""After the last message: leaving the mesh would cut off what is still on its way out."""
TICK_S = 1 / 120
"""Of a clock that is made here, for a capture that has none."""


def played_keys(capture: Capture, only: Iterable[str], hardware: bool) -> frozenset[str]:
    """What of a capture is played: everything that components published, but for what recorders said of themselves.

    Raises ConfigError when that is nothing.
    """
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
        raise ConfigError(f"{capture.path}: of what is asked for it has nothing to play")
    return frozenset(keys)


def services_of(keys: Iterable[str]) -> frozenset[str]:
    """Whose keys these are."""
    return frozenset(service_of(key) for key in keys)


async def refuse_if_alive(bus: Bus, robot: str, services: frozenset[str]) -> None:
    """Raises RefusedError when a robot of that name is there, or anyone whose keys are to be played."""
    alive = {service_of(key) for key in await bus.alive(alive_key(robot))}
    hardware = sorted(alive & {*processes.hardware(), SIMULATOR})
    if hardware:
        raise RefusedError(
            f"a robot named {robot} is alive ({', '.join(hardware)}), and a capture is not played into its mesh; "
            f"`cocoro down --robot {robot}` stops it"
        )
    if others := sorted(alive & services):
        raise RefusedError(
            f"{', '.join(others)} of {robot} is alive, and its keys are to be played; "
            f"stop it, or leave its keys out by --only or --hardware"
        )


class Replay:
    """Plays on a bus until the capture's end, or for ever. `player` may be worked meanwhile; tell `changed` then."""

    def __init__(self, bus: Bus, capture: Capture, player: Player, *, hardware: bool = False) -> None:
        """With `hardware` the liveliness of the hardware's services is there too, and always a clock."""
        self.sent = 0
        self._bus = bus
        self._capture = capture
        self._player = player
        self._hardware = hardware
        self._publishers: dict[str, RawPublisher] = {}
        self._handles: list[Handle] = []
        self._changed = asyncio.Event()
        self._clock_key = CLOCK.key(capture.robot)
        self._ticks = 0
        self._incarnation = bus.new_incarnation()

    def changed(self) -> None:
        """The player was worked by hand."""
        self._changed.set()

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        for key in self._player.keys:
            self._publisher(key)
        if self._hardware:
            self._handles += [
                self._bus.declare_alive(alive_key(self._capture.robot, name)) for name in processes.hardware()
            ]
        ticking = None
        if self._hardware and self._clock_key not in self._player.keys:
            ticking = asyncio.create_task(self._tick_for_ever())
        try:
            while True:
                passes = self._player.passes
                records = self._player.due(loop.time())
                if ticking is not None and self._player.passes != passes:
                    self._tick()  # the new epoch begins before what is of it
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
        """As it was published; a message of a former shape in today's, a lossy frame as a frame."""
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
        """Everything is played as events are: what a live mesh may leave out under load, a replay may not."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._bus.publisher(key, Qos.EVENT)
        return publisher

    async def _tick_for_ever(self) -> None:
        while True:
            self._tick()
            await asyncio.sleep(TICK_S)

    def _tick(self) -> None:
        """A real robot's capture has no clock: its stamps are of the system's, as the log times are."""
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
"""Incarnations are drawn from so many."""
_PARTS = ("consumed", "produced")


def restarted(payload: bytes | memoryview, passes: int) -> bytes | memoryview:
    """The payload for a time line that has gone back so often. What is no MessagePack map stays as it is."""
    if passes == 0:
        return payload
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return payload
    return msgspec.msgpack.encode(_restarted(message, passes)) if isinstance(message, dict) else payload


def with_rate(payload: bytes | memoryview, rate: float) -> bytes | memoryview:
    """A clock's message, where time goes `rate` times as fast as it was recorded."""
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
