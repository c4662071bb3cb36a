"""One message that cannot be right, well typed and of the real publisher, while the robot drives: what it costs.

Policies: docs/faults.md.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import msgpack
import pytest
from robot_rig import HALTED_MPS, RobotRig

import cocoro.clock
from cocoro import topics
from cocoro.clock import NS, Clock, FollowedClock, VirtualClock
from cocoro.messages import EstopRequest, Health, TaskState
from cocoro.testing import in_virtual_time
from cocoro.topics import HEALTH, Topic
from cocoro.vloop import run_virtual

pytestmark = pytest.mark.sim

FAR = 2**62
STANDS_S = 0.45
"""For so long at most one bad message makes the robot less than half as fast: 0.25 s until the true stamps have passed
the wrong one, three messages at 50 Hz, and the ramps down and up, less the patience that there is at full speed."""
KEYS: tuple[Topic[Any], ...] = (topics.BASE_COMMAND, topics.BASE_STATE, topics.LATCH)


def newest(rig: RobotRig, topic: Topic[Any]) -> dict[str, Any]:
    """The newest message on a key, as it travelled."""
    data: dict[str, Any] = msgpack.unpackb(rig.tap._payloads[topic.name][-1])
    return data


def send(rig: RobotRig, topic: Topic[Any], message: dict[str, Any]) -> None:
    rig.mesh.publish(topic.key(rig.operator.robot_name), msgpack.packb(message))


def at_once(message: dict[str, Any]) -> dict[str, Any]:
    return message | {"seq": FAR}


def near(message: dict[str, Any]) -> dict[str, Any]:
    """A number that could be traffic, and a stamp that two machines' clocks may differ by."""
    return message | {"seq": message["seq"] + 900, "stamp_ns": message["stamp_ns"] + NS // 4}


def late(message: dict[str, Any]) -> dict[str, Any]:
    return message | {"seq": message["seq"] + 1, "stamp_ns": FAR}


def told(rig: RobotRig, service: str) -> tuple[str, ...]:
    healths: list[Health] = rig.tap.messages(HEALTH.of(service))
    return healths[-1].faults


ClockOf = Callable[[str], Clock]
Spoil = Callable[[dict[str, Any]], dict[str, Any]]
READER = {"sim/clock": "planning", "base/command": "base", "base/state": "planning", "executive/latch": "base"}
PUBLISHER = {"base/command": "planning", "base/state": "base", "executive/latch": "executive"}


class Drive(NamedTuple):
    """From the bad message on."""

    speeds_mps: list[float]
    outcome: TaskState
    told: tuple[str, ...]
    """The faults in the reader's health."""


def drive(topic: Topic[Any] | None = None, spoil: Spoil | None = None, clock_of: ClockOf | None = None) -> Drive:
    """Drive to the can; on the way send one bad message, if any."""

    async def scenario() -> Drive:
        async with RobotRig(clock_of=clock_of) as rig:
            task_id = await rig.driving(0.2, "go-to")
            sent_s = rig.now_s
            if topic is not None and spoil is not None:
                send(rig, topic, spoil(newest(rig, topic)))
            await rig.advance(1.2)
            speeds = rig.speeds_since(sent_s)
            faults = told(rig, READER[topic.name]) if topic is not None else ()
            return Drive(speeds, await rig.outcome(task_id), faults)

    return run_virtual(scenario())


@cache
def undisturbed(clock_of: ClockOf | None = None) -> Drive:
    return drive(clock_of=clock_of)


def stood_s(disturbed: Drive, other: Drive) -> float:
    """For how long it was less than half as fast as it would have been."""
    slow = [speed for speed, right in zip(disturbed.speeds_mps, other.speeds_mps, strict=True) if speed < right / 2]
    return len(slow) / (topics.TRUTH.rate_hz or 30.0)


@pytest.mark.parametrize("spoil", [at_once, late])
@pytest.mark.parametrize("topic", KEYS, ids=lambda topic: topic.name)
def test_one_message_that_cannot_be_right_changes_nothing_and_its_key_and_publisher_are_named(
    topic: Topic[Any], spoil: Spoil
) -> None:
    right, bad = undisturbed(), drive(topic, spoil)
    assert bad.speeds_mps == right.speeds_mps
    assert bad.outcome.outcome == "done"
    assert bad.outcome.elapsed_s == right.outcome.elapsed_s
    blamed = [fault for fault in bad.told if fault.startswith(f"{topic.name} of {PUBLISHER[topic.name]}: 1 rejected: ")]
    assert blamed
    if spoil is at_once:
        assert "cannot be traffic" in blamed[0]


@pytest.mark.parametrize("topic", KEYS, ids=lambda topic: topic.name)
def test_one_message_that_could_be_right_and_is_not_stops_nothing_for_long(topic: Topic[Any]) -> None:
    bad = drive(topic, near)
    assert stood_s(bad, undisturbed()) <= STANDS_S
    assert bad.speeds_mps[-1] > 0.19, "it goes on"
    assert any(fault.startswith(f"{topic.name} of {PUBLISHER[topic.name]}: ") for fault in bad.told)
    assert bad.outcome.outcome == "done"


@pytest.mark.parametrize("spoil", [at_once, near, late])
def test_a_command_from_ahead_lengthens_no_deadman_when_the_planner_dies_after_it(spoil: Spoil) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            await rig.driving(0.2)
            send(rig, topics.BASE_COMMAND, spoil(newest(rig, topics.BASE_COMMAND)))
            await rig.advance(0.001)
            died_s = rig.now_s
            await rig.kill("planning")
            await rig.advance(1.0)
            assert not rig.base_obeys_since(died_s + 0.16)
            assert max(rig.speeds_since(died_s + 0.3)) < HALTED_MPS

    scenario()


@pytest.mark.parametrize("spoil", [at_once, near, late])
def test_the_latch_still_latches_after_a_bad_word_on_it(spoil: Spoil) -> None:
    """By the executive's word alone, as who starts later or missed the request hears it."""

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            await rig.driving(0.2)
            send(rig, topics.LATCH, spoil(newest(rig, topics.LATCH)))
            pressed_s = rig.now_s
            await rig.operator.call(topics.ESTOP.of("executive"), EstopRequest(by="test"))
            await rig.advance(1.5)
            states = [state for state in rig._base if state.latch == "latched"]
            assert states
            assert states[0].stamp_ns / NS - pressed_s < 0.25 + 3 * 0.2 + 0.05
            assert max(rig.speeds_since(pressed_s + 0.3)) < HALTED_MPS

    scenario()


@pytest.mark.parametrize("topic", [topics.BASE_COMMAND, topics.BASE_STATE], ids=lambda topic: topic.name)
def test_a_task_whose_key_stays_unreadable_fails_and_says_which_and_why(topic: Topic[Any]) -> None:
    """The publisher's sequence numbers jump, so that no message can be trusted."""

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            task_id = await rig.driving(0.2)
            since_s = rig.now_s
            publisher = rig._services[PUBLISHER[topic.name] if topic is topics.BASE_COMMAND else "sim"].node
            raw = _raw_of(rig, publisher, topic)
            raw.put = _jumping(raw.put)
            state = await rig.outcome(task_id, timeout_s=5.0)
            assert state.outcome == "failed"
            reader = READER[topic.name]
            assert state.reason.startswith("unreadable: ")
            assert f" cannot read {topic.name} of {PUBLISHER[topic.name]}: " in state.reason
            assert "rejected: sequence number " in state.reason
            # Without the base's state the executive cannot see that it rests, and waits until its limit.
            assert rig.now_s - since_s < (1.5 if topic is topics.BASE_COMMAND else 4.5)
            assert max(rig.speeds_since(since_s + 0.5)) < HALTED_MPS
            refused = await rig.ask("fetch", "red_can")
            assert refused.refusal == "not_alive"
            assert f"cannot read {topic.name} of" in refused.text
            assert any(fault.startswith(topic.name) for fault in told(rig, reader))

            del raw.put  # it is itself again
            await rig.advance(1.0)
            assert (await rig.run("fetch", "red_can")).outcome == "done"

    scenario()


def _raw_of(rig: RobotRig, node: Any, topic: Topic[Any]) -> Any:
    if topic.name in node._publishers:
        return node._publishers[topic.name]._raw
    simulated = [
        handle for handle in rig._services["sim"].bus._declared if getattr(handle, "_key", "").endswith(topic.name)
    ]
    return simulated[0]


def _jumping(put: Callable[[bytes], None]) -> Callable[[bytes], None]:
    sent = 0

    def put_wrong(payload: bytes) -> None:
        nonlocal sent
        sent += 1
        message = msgpack.unpackb(payload)
        put(msgpack.packb(message | {"seq": FAR + (-1) ** sent * sent * 10_000}))

    return put_wrong


# --- the clock key ----------------------------------------------------------------------------------


@pytest.fixture
def loop_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine's steady clock is the virtual loop's time, by which the followed clocks measure the ticks."""

    class Time:
        CLOCK_BOOTTIME = "boottime"

        @staticmethod
        def clock_gettime_ns(_: object) -> int:
            return round(asyncio.get_running_loop().time() * NS)

    monkeypatch.setattr(cocoro.clock, "time", Time)


def followed(service: str) -> Clock:
    """The simulator makes the time, the others follow its key, each by itself."""
    return VirtualClock() if service == "sim" else FollowedClock()


def ahead(seconds: float) -> Spoil:
    def spoil(tick: dict[str, Any]) -> dict[str, Any]:
        return tick | {"seq": tick["seq"] + 1, "stamp_ns": tick["stamp_ns"] + round(seconds * NS)}

    return spoil


@pytest.mark.usefixtures("loop_time")
@pytest.mark.parametrize("spoil", [ahead(0.25), ahead(1.0), ahead(3600.0), ahead(FAR / NS), at_once])
def test_one_tick_that_cannot_be_right_changes_nothing(spoil: Spoil) -> None:
    right, bad = undisturbed(followed), drive(topics.CLOCK, spoil, followed)
    assert bad.speeds_mps == right.speeds_mps
    assert bad.outcome.outcome == "done"
    assert any(fault.startswith("sim/clock of sim: 1 rejected: ") for fault in bad.told)


@pytest.mark.usefixtures("loop_time")
def test_one_tick_that_is_a_little_ahead_stops_nothing_for_long() -> None:
    bad = drive(topics.CLOCK, ahead(0.1), followed)
    assert stood_s(bad, undisturbed(followed)) <= STANDS_S
    assert bad.outcome.outcome == "done"
