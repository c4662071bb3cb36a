"""The emulated Create does what the manual says a Create does."""

from __future__ import annotations

from math import pi

import pytest

from sim.wire.create import FULL, OFF, PASSIVE, SAFE, EmulatedCreate

MS = 1_000_000
BAUD = 57600


class Wire:
    """A Create in passive mode, with direct access to its bytes."""

    def __init__(self) -> None:
        self.create = EmulatedCreate()
        self.now_ns = 0
        self.say(128)

    def say(self, *data: int) -> bytes:
        self.create.receive(bytes(data), BAUD, self.now_ns)
        return self.create.advance(BAUD, self.now_ns)

    def wait(self, ms: int) -> bytes:
        heard = b""
        for _ in range(ms):
            self.now_ns += MS
            heard += self.create.advance(BAUD, self.now_ns)
        return heard


def test_a_create_that_is_off_hears_nothing_but_start() -> None:
    create = EmulatedCreate()
    create.receive(bytes([131, 145, 0, 100, 0, 100]), BAUD, 0)
    assert (create.mode, create.wheels_mmps) == (OFF, (0, 0))
    create.receive(bytes([128]), BAUD, 0)
    assert create.mode == PASSIVE


def test_passive_mode_ignores_the_wheels_and_safe_and_full_obey() -> None:
    wire = Wire()
    wire.say(145, 0, 100, 0, 100)
    assert wire.create.wheels_mmps == (0, 0)
    for opcode, mode in ((131, SAFE), (132, FULL)):
        wire.say(opcode, 145, 0, 100, 255, 56)  # right, then left
        assert wire.create.mode == mode
        assert wire.create.wheels_mmps == (-200, 100)


def test_the_manuals_drive_example_goes_backward_and_turns() -> None:
    wire = Wire()
    wire.say(131, 137, 255, 56, 1, 244)  # -200 mm/s, radius 500 mm: to the left
    left, right = wire.create.wheels_mmps
    assert (left + right) / 2 == pytest.approx(-200, abs=1)
    assert right < left < 0
    wire.say(137, 0, 100, 0x80, 0)
    assert wire.create.wheels_mmps == (100, 100)
    wire.say(137, 0, 100, 0, 1)
    assert wire.create.wheels_mmps == (-100, 100)


def test_the_stream_has_the_manuals_form_and_pace() -> None:
    wire = Wire()
    assert wire.say(148, 2, 29, 13) == b""
    frames = wire.wait(150)
    assert frames == bytes([19, 5, 29, 0, 0, 13, 0, -sum((19, 5, 29, 13)) & 0xFF]) * 10
    wire.say(150, 0)
    assert wire.wait(60) == b""
    wire.say(150, 1)
    assert len(wire.wait(60)) == 4 * 8


def test_way_and_turn_are_whole_units_since_they_were_asked_for_and_the_rest_is_forgotten() -> None:
    wire = Wire()
    wire.create.roll(0.0109, 0.0109)
    assert wire.say(142, 19) == bytes([0, 10])
    assert wire.say(142, 19) == bytes([0, 0])
    quarter_m = 0.258 * pi / 4  # each wheel, for a quarter turn
    wire.create.roll(-quarter_m, quarter_m)
    assert wire.say(149, 2, 19, 20) == bytes([0, 0, 0, 90])
    wire.create.roll(0.002, -0.002)
    assert wire.say(142, 20) == bytes([0, 0])


def test_groups_have_the_sizes_of_the_manual() -> None:
    wire = Wire()
    sizes = {0: 26, 1: 10, 2: 6, 3: 10, 4: 14, 5: 12, 6: 52}
    assert {group: len(wire.say(142, group)) for group in sizes} == sizes


@pytest.mark.parametrize("field", ["drop_left", "drop_right", "drop_caster", "charger"])
def test_safe_mode_falls_back_to_passive_and_stops(field: str) -> None:
    wire = Wire()
    wire.say(131, 145, 0, 100, 0, 100)
    setattr(wire.create.sensors, field, True)
    wire.wait(1)
    assert (wire.create.mode, wire.create.wheels_mmps) == (PASSIVE, (0, 0))
    wire.say(132, 145, 0, 100, 0, 100)
    wire.wait(1)
    assert (wire.create.mode, wire.create.wheels_mmps) == (FULL, (100, 100))


def test_a_cliff_stops_it_in_safe_mode_unless_it_backs_away() -> None:
    wire = Wire()
    wire.create.sensors.cliffs[1] = True
    wire.say(131, 145, 255, 156, 255, 156)
    wire.wait(1)
    assert (wire.create.mode, wire.create.wheels_mmps) == (SAFE, (-100, -100))
    wire.say(145, 255, 156, 0, 50)
    wire.wait(1)
    assert wire.create.mode == PASSIVE


def test_data_in_an_opcodes_place_is_an_opcode() -> None:
    wire = Wire()
    wire.say(131, 145, 0, 145, 0)  # one byte was lost: what follows is read shifted
    wire.say(145, 0, 100, 0, 100)
    assert wire.create.wheels_mmps == (145, 145)
    wire.say(145, 0, 100, 0, 100)
    assert wire.create.wheels_mmps == (100, 100)
    wire.say(135)
    assert wire.create.mode == PASSIVE
    assert wire.create.wheels_mmps != (0, 0)  # a demo drives on its own
    wire.say(136, 255)
    assert wire.create.wheels_mmps == (0, 0)


def test_it_is_deaf_while_it_waits_and_obeys_then() -> None:
    wire = Wire()
    wire.say(131, 145, 0, 100, 0, 100, 155, 2, 145, 0, 0, 0, 0)
    wire.wait(199)
    assert wire.create.wheels_mmps == (100, 100)
    wire.wait(2)
    assert wire.create.wheels_mmps == (0, 0)
    wire.say(145, 0, 100, 0, 100, 156, 0, 50, 145, 0, 0, 0, 0)
    wire.create.roll(0.049, 0.049)
    wire.wait(1)
    assert wire.create.wheels_mmps == (100, 100)
    wire.create.roll(0.002, 0.002)
    wire.wait(1)
    assert wire.create.wheels_mmps == (0, 0)


def test_it_hears_only_at_its_own_baud_rate_and_can_change_it() -> None:
    wire = Wire()
    wire.create.receive(bytes([131]), 115200, 0)
    assert wire.create.mode == PASSIVE
    wire.say(129, 11)
    wire.create.receive(bytes([131]), 115200, 0)
    assert wire.create.mode == SAFE
    wire.create.power_cycle()
    assert (wire.create.mode, wire.create.baud) == (OFF, 57600)
