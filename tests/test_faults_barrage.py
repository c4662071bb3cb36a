"""Bad input on every key of a robot that works: each is counted and dropped, and the robot does as if it were not."""

from __future__ import annotations

import random
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import cycle
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from message_samples import data_of, leaves_in, replaced
from robot_rig import RobotRig

from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.messages import TaskState
from cocoro.testing import in_virtual_time
from cocoro.topics import CLOCK, TOPICS, Topic
from cocoro.vloop import run_virtual

pytestmark = pytest.mark.sim

SERVICES = ("kinect", "base", "arm", "hand", "perception", "planning", "executive")
PERIOD_S = 0.00043
"""Period of the invalid messages. It keeps them apart from each other and nearly always from valid ones, since the bus
keeps only the newest of simultaneous messages."""
TOPICS_NOW: tuple[Topic[Any], ...] = tuple(topic for topic in TOPICS if "{" not in topic.name)
"""The topics that do not exist per service."""


# --- what is bad ------------------------------------------------------------------------------------


def is_good(topic: Topic[Any], payload: bytes) -> bool:
    try:
        msgspec.msgpack.decode(payload, type=topic.type)
    except (msgspec.MsgspecError, ValueError):
        return False
    return True


@cache
def too_large(topic: Topic[Any]) -> bytes:
    """Made once: whoever keeps what was sent would keep each of them."""
    return bytes(topic.max_bytes + 1)


def spoilt(topic: Topic[Any], good: bytes, draw: random.Random) -> Iterator[bytes]:
    """Invalid payloads made from a valid one."""
    data = msgpack.unpackb(good)
    yield b""
    yield bytes(draw.randrange(256) for _ in range(draw.randrange(1, 40)))
    yield good[: draw.randrange(len(good))]
    yield msgpack.packb(replaced(data, draw.choice(list(leaves_in(data))), {"what": "is this"}))
    yield msgpack.packb([data])
    yield too_large(topic)
    for _ in range(3):
        flipped = bytearray(good)
        flipped[draw.randrange(min(len(good), 200))] ^= 1 << draw.randrange(8)
        if not is_good(topic, bytes(flipped)):  # otherwise nobody could tell it from one that was meant
            yield bytes(flipped)
    yield good  # once more
    if topic.qos is Qos.COMMAND and topic != CLOCK:
        # As if from another publisher, so that it is its age that is against it.
        stale = data | {"incarnation": data["incarnation"] + 1_000_000, "stamp_ns": max(data["stamp_ns"] - 10**9, 1)}
        yield msgpack.packb(stale)
        yield msgpack.packb(stale | {"stamp_ns": data["stamp_ns"] + 10**10})


class Barrage:
    """Publishes bad messages on one key after the other, made from what was really said there."""

    def __init__(self, rig: RobotRig, seed: int) -> None:
        self._rig = rig
        self._draw = random.Random(seed)
        self._said: dict[str, bytes] = {}
        self._ours: set[int] = set()
        """Hashes of what it sent."""
        self.sent: Counter[str] = Counter()
        rig.mesh.join().subscribe(f"{rig.operator.robot_name}/**", Qos.EVENT, self._hear, depth=1)

    def _hear(self, key: str, payload: bytes | memoryview) -> None:
        if hash(bytes(payload)) not in self._ours:
            self._said[key.partition("/")[2]] = bytes(payload)

    async def fire(self) -> None:
        for topic in cycle(TOPICS_NOW):
            good = self._said.get(topic.name)
            for payload in spoilt(topic, good, self._draw) if good is not None else (b"",):
                await self._rig.operator.sleep(PERIOD_S)
                self._ours.add(hash(payload))
                self._rig.mesh.publish(topic.key(self._rig.operator.robot_name), payload)
                self.sent[topic.name] += 1


async def fetched(barrage_seed: int | None) -> TaskState:
    async with RobotRig() as rig:
        barrage = Barrage(rig, barrage_seed or 0)
        if barrage_seed is not None:
            rig.operator.spawn(barrage.fire())
        state = await rig.run("fetch", "red_can")
        assert state.outcome == "done", state.reason
        assert rig.held("red_can")
        if barrage_seed is not None:
            await rig.advance(1.1)  # every service publishes its health
            was_counted(rig, barrage)
        return state


def was_counted(rig: RobotRig, barrage: Barrage) -> None:
    """Every service's health has counted what it was sent."""
    rejected: dict[str, dict[str, int]] = defaultdict(dict)
    for service in SERVICES:
        for port in rig.tap.messages(topics.HEALTH.of(service))[-1].topics:
            if port.direction == "in":
                rejected[service][port.key.partition("/")[2]] = port.rejected
    heard = {(service, name) for service, counts in rejected.items() for name in counts if name in barrage.sent}
    assert heard >= {
        ("base", "base/command"), ("arm", "arm/command"), ("hand", "hand/command"), ("base", "executive/latch"),
        ("perception", "kinect/frame"), ("perception", "arm/state"), ("planning", "executive/intent"),
        ("planning", "base/state"), ("planning", "perception/detections"), ("planning", "perception/obstacles"),
        ("executive", "planning/status"), ("executive", "base/state"),
    }  # fmt: skip
    for service, name in heard:
        # The last ones were sent after the health was published.
        assert 0.8 * barrage.sent[name] <= rejected[service][name] <= barrage.sent[name], (service, name)
        assert barrage.sent[name] > 100


def test_under_a_barrage_of_bad_messages_on_every_key_it_fetches_as_if_there_were_none() -> None:
    undisturbed = run_virtual(fetched(None))
    assert run_virtual(fetched(1)).elapsed_s == undisturbed.elapsed_s


# --- well-typed nonsense ----------------------------------------------------------------------------


@settings(max_examples=8, phases=[Phase.explicit, Phase.generate])
@given(data=st.data())
def test_well_typed_nonsense_on_every_key_ends_no_service(data: st.DataObject) -> None:
    nonsense = [(topic, msgpack.packb(data.draw(data_of(topic.type)))) for topic in TOPICS_NOW for _ in range(4)]
    data.draw(st.randoms(use_true_random=False)).shuffle(nonsense)

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            await rig.begin("fetch", "red_can")
            for topic, payload in nonsense:
                rig.mesh.publish(topic.key(rig.operator.robot_name), payload)
                await rig.advance(0.011)
            await rig.advance(2.0)  # raises what a service raised
            await rig.cancel()
            await rig.estop(latched=False)
            await rig.advance(3.0)
            assert (await rig.run("park")).outcome == "done"

    scenario()
