"""The guard's decisions: when wheels may turn, what is written to the Create, and how damaged input is handled."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_base import frame

from services.base import oi
from services.base.guard_logic import LONG, MS, SHORT, GuardLogic, WheelSpeeds, reflex

QUIET = dict.fromkeys(SHORT, 0) | {oi.MODE: 2}


class Rig:
    """The guard's logic, a clock, and a Create that obeys."""

    def __init__(self) -> None:
        self.logic = GuardLogic("safe", 200 * MS)
        self.now_ns = 10**12
        self.written = b""
        self.readings = dict(QUIET)
        self.streams: tuple[int, ...] = ()
        self.logic.opened(self.now_ns)

    def frames(self, count: int, **changes: int) -> list[oi.Readings]:
        """Pass this many frames of 15 ms; what the logic writes meanwhile is in `written`."""
        self.written = b""
        heard = []
        for _ in range(count):
            self.now_ns += 15 * MS
            self.poll()
            if self.streams:
                readings = {packet: self.readings.get(packet, 0) for packet in self.streams}
                heard += self.logic.receive(frame(readings), self.now_ns)
        self.poll()
        return heard

    def poll(self) -> None:
        data = self.logic.poll(self.now_ns)
        self.written += data
        for packets in (SHORT, LONG):
            if oi.stream(packets) in data:
                self.streams = packets
        at = data.rfind(oi.DRIVE_DIRECT)
        if at >= 0 and len(data) - at >= 5:
            self.readings[oi.RIGHT_SPEED] = int.from_bytes(data[at + 1 : at + 3], "big", signed=True)
            self.readings[oi.LEFT_SPEED] = int.from_bytes(data[at + 3 : at + 5], "big", signed=True)


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.frames(12)
    assert rig.logic.link == "up"
    return rig


def test_waking_stops_the_wheels_first_and_then_enters_the_mode() -> None:
    rig = Rig()
    rig.frames(12)
    assert rig.written.startswith(oi.halt())
    assert rig.written.index(oi.enter("safe")) < rig.written.index(oi.stream(SHORT))


def test_way_and_turn_are_asked_for_five_times_a_second_and_for_one_frame_each(rig: Rig) -> None:
    heard = rig.frames(134)  # 2 s
    counted = sum(oi.DISTANCE in readings for readings in heard)
    assert 8 <= counted <= 10
    assert rig.written.count(oi.stream(LONG)) == pytest.approx(counted, abs=1)
    assert not rig.logic.take_counts_lost()


def test_a_frame_that_is_broken_while_counts_are_asked_for_loses_them(rig: Rig) -> None:
    for _ in range(20):
        rig.now_ns += 15 * MS
        rig.poll()
        if rig.streams == LONG:
            break
        rig.logic.receive(frame({packet: rig.readings[packet] for packet in SHORT}), rig.now_ns)
    assert not rig.logic.take_counts_lost()
    rig.logic.receive(b"\x13\x07rubbish", rig.now_ns)
    rig.frames(2)
    assert rig.logic.take_counts_lost()
    assert not rig.logic.take_counts_lost()


def test_a_wheel_command_is_repeated_though_nothing_changes(rig: Rig) -> None:
    rig.logic.ask(100, 50, rig.now_ns + 200 * MS, rig.now_ns)
    rig.frames(10)
    assert rig.written.count(oi.drive_direct(100, 50)) >= 3


def test_a_command_that_the_create_took_for_another_is_repeated_at_once(rig: Rig) -> None:
    rig.logic.ask(100, 100, rig.now_ns + 200 * MS, rig.now_ns)
    rig.frames(2)
    rig.readings[oi.LEFT_SPEED] = 400
    rig.written = b""
    rig.now_ns += 15 * MS
    rig.logic.receive(frame({packet: rig.readings[packet] for packet in SHORT}), rig.now_ns)
    assert rig.logic.poll(rig.now_ns).endswith(oi.drive_direct(100, 100))


def test_a_create_that_takes_commands_for_the_rest_of_another_gets_more_than_it_can_take(rig: Rig) -> None:
    """A garbled byte may have become the start of a script, which swallows up to 255 following bytes."""
    rig.logic.ask(100, 100, rig.now_ns + 200 * MS, rig.now_ns)
    rig.frames(2)
    rig.logic.ask(0, 0, rig.now_ns + 200 * MS, rig.now_ns)
    written, taken = [], dict(rig.readings)
    for _ in range(8):
        rig.now_ns += 15 * MS
        rig.logic.receive(frame({packet: taken[packet] for packet in SHORT}), rig.now_ns)
        written.append(rig.logic.poll(rig.now_ns))
    assert max(len(data) for data in written) > 255
    assert set(b"".join(written)) == set(oi.drive_direct(0, 0))


def test_a_silent_create_gets_no_wheel_speeds_and_is_woken_again_and_again(rig: Rig) -> None:
    rig.streams = ()
    rig.logic.ask(100, 100, rig.now_ns + 200 * MS, rig.now_ns)
    written = []
    for _ in range(100):
        rig.now_ns += 15 * MS
        rig.logic.ask(100, 100, rig.now_ns + 200 * MS, rig.now_ns)
        written.append(rig.logic.poll(rig.now_ns))
    silent = b"".join(written[12:])
    assert oi.drive_direct(100, 100) not in silent
    assert oi.drive_direct(0, 0) in silent
    assert b"".join(written).count(oi.start()) >= 2
    assert rig.logic.link in ("silent", "waking")


READINGS = st.fixed_dictionaries(
    {
        oi.BUMPS: st.integers(0, 31),
        oi.OVERCURRENTS: st.integers(0, 31),
        **dict.fromkeys(oi.CLIFFS, st.integers(0, 1)),
    }
)
SPEED = st.integers(-500, 500).map(oi.harmless)


@given(SPEED, SPEED, READINGS)
def test_reflexes_never_let_the_robot_forward_against_what_they_feel(
    left: int, right: int, readings: oi.Readings
) -> None:
    allowed = reflex(WheelSpeeds(left, right), readings)
    felt = readings[oi.BUMPS] & 3 or any(readings[packet] for packet in oi.CLIFFS)
    if felt:
        assert allowed.left_mmps + allowed.right_mmps <= 0 or abs(allowed.left_mmps + allowed.right_mmps) <= 32
        assert allowed.left_mmps + allowed.right_mmps <= max(left + right, 32)
    if readings[oi.BUMPS] & oi.WHEEL_DROPS:
        assert allowed[:2] == (0, 0)
    if not allowed.why:
        assert allowed[:2] == (left, right)


STEPS = st.one_of(
    st.tuples(st.just("bytes"), st.binary(max_size=40)),
    st.tuples(st.just("frame"), st.sampled_from([0, 1, 2, 3])),
    st.tuples(st.just("ask"), st.tuples(st.integers(-600, 600), st.integers(-600, 600), st.integers(-100, 400))),
    st.tuples(st.just("wait"), st.integers(1, 300)),
    st.tuples(st.just("recover"), st.none()),
    st.tuples(st.just("closed"), st.none()),
)


@settings(max_examples=200)
@given(st.lists(STEPS, max_size=40))
def test_whatever_comes_wheels_turn_only_for_a_fresh_command_and_an_awake_create(
    steps: list[tuple[str, Any]],
) -> None:
    logic, now_ns, until_ns = GuardLogic("safe", 200 * MS), 10**12, 0
    logic.opened(now_ns)
    for step, value in steps:
        if step == "bytes":
            logic.receive(value, now_ns)
        elif step == "frame":
            logic.receive(frame(QUIET | {oi.MODE: value}), now_ns)
        elif step == "ask":
            left, right, for_ms = value
            until_ns = min(now_ns + for_ms * MS, now_ns + 200 * MS)
            logic.ask(left, right, now_ns + for_ms * MS, now_ns)
        elif step == "wait":
            now_ns += value * MS
        elif step == "recover":
            logic.recover(now_ns)
        else:
            logic.closed()
            logic.opened(now_ns)
        logic.poll(now_ns)
        if logic.wheels[:2] != (0, 0):
            assert now_ns <= until_ns
            assert logic.link == "up"
            assert logic.readings[oi.MODE] == 2
