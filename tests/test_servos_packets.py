"""Answers of servos: found when they are complete, and nothing else is; registers decoded correctly."""

from __future__ import annotations

import itertools
from math import degrees, radians

import pytest
from dynamixel_sdk.protocol1_packet_handler import Protocol1PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from cocoro.joints import Joint
from cocoro.robot import Robot
from cocoro.servo_units import UNITS, Protocol
from services.servos.bus import asked, find_status
from services.servos.cycle import STATE
from services.servos.dynamixel import DYNAMIXEL, slope_of
from services.servos.families import FAMILIES
from services.servos.family import READING_LENGTH, ServoFamily, ServoReading, signed
from services.servos.feetech import FEETECH


def status(number: int, error: int, data: bytes) -> bytes:
    body = bytes([number, len(data) + 2, error]) + data
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


REFUSALS = DYNAMIXEL.refusals
STATUS = st.builds(status, st.integers(0, 253), st.integers(0, 127), st.binary(min_size=8, max_size=8))


class Recorder:
    """A port that records what the SDK writes."""

    is_using = False

    def __init__(self) -> None:
        self.written = b""

    def clearPort(self) -> None:  # noqa: N802 # the SDK's name
        pass

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self.written = bytes(packet)
        return len(packet)

    def setPacketTimeout(self, length: int) -> None:  # noqa: N802
        pass


def test_the_manuals_example_of_a_read_is_what_goes_out() -> None:
    port = Recorder()
    Protocol1PacketHandler().readTx(port, 1, DYNAMIXEL.registers["temperature"].address, 1)
    assert port.written == bytes.fromhex("FF FF 01 04 02 2B 01 CC")
    assert asked(port.written) == (1, 1)


def test_the_manuals_example_of_an_answer_is_read() -> None:
    found = find_status(bytes.fromhex("FF FF 01 03 00 20 DB"), 1, 1, REFUSALS)
    assert found is not None
    assert (found.error, found.data) == (0, b"\x20")


def test_who_is_asked_for_what() -> None:
    assert asked(bytes.fromhex("FF FF 05 04 03 18 01 DA")) == (5, 0)
    assert asked(bytes.fromhex("FF FF FE 02 05 FA")) is None


@given(STATUS, st.binary(max_size=20), st.binary(max_size=20))
def test_an_answer_is_found_in_whatever_is_around_it(packet: bytes, before: bytes, after: bytes) -> None:
    found = find_status(before + packet + after, packet[2], 8, REFUSALS)
    assert found is not None
    assert found.packet in before + packet + after


@given(STATUS, st.data())
def test_a_changed_or_missing_byte_never_gets_through(packet: bytes, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(packet) - 1))
    changed = packet[:at] + bytes([packet[at] ^ data.draw(st.integers(1, 255))]) + packet[at + 1 :]
    assert find_status(changed, packet[2], 8, REFUSALS) is None
    assert find_status(packet[:at] + packet[at + 1 :], packet[2], 8, REFUSALS) is None


@given(STATUS)
def test_another_servos_answer_or_one_of_another_length_is_none(packet: bytes) -> None:
    assert find_status(packet, (packet[2] + 1) % 254, 8, REFUSALS) is None
    assert find_status(packet, packet[2], 2, REFUSALS) is None


def test_a_refusal_comes_without_data_and_a_late_confirmation_is_no_refusal() -> None:
    refusal = find_status(status(4, 0x08, b""), 4, 8, REFUSALS)
    assert refusal is not None
    assert DYNAMIXEL.errors_in(refusal.error) == ("range",)
    assert find_status(status(4, 0, b""), 4, 8, REFUSALS) is None
    assert find_status(status(4, 0x20, b""), 4, 8, REFUSALS) is None


@given(st.binary(max_size=300), st.integers(0, 253), st.integers(0, 20))
def test_rubbish_is_no_answer(rubbish: bytes, number: int, length: int) -> None:
    found = find_status(rubbish, number, length, REFUSALS)
    if found is not None:
        assert found.packet in rubbish
        assert ~sum(found.packet[2:-1]) & 0xFF == found.packet[-1]


families = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)


@pytest.mark.parametrize(
    ("family", "data", "values"),
    [
        (DYNAMIXEL, "20 01 0A 00 64 04 78 2D", (0x120, 10, -100)),
        (FEETECH, "20 0A 0A 80 64 04 78 2D", (0xA20, -10, -100)),  # the speed's sign is bit 15, the load's bit 10
        (FEETECH, "05 80 E8 03 E8 03 78 2D", (-5, 1000, 1000)),  # beyond its zero, if it counts turns
    ],
)
def test_a_reading_is_what_the_registers_say(family: ServoFamily, data: str, values: tuple[int, int, int]) -> None:
    assert family.reading(bytes.fromhex(data), 0, 7) == ServoReading(*values, 12.0, 45, 0, 7)


@pytest.mark.parametrize(("family", "at"), [(DYNAMIXEL, 1), (DYNAMIXEL, 3), (DYNAMIXEL, 5), (FEETECH, 3), (FEETECH, 5)])
def test_a_reading_that_no_servo_can_measure_is_none(family: ServoFamily, at: int) -> None:
    data = bytearray(8)
    data[at] = 0xF0
    assert family.reading(bytes(data), 0, 0) is None


@given(st.integers(-32767, 32767))
def test_a_sign_and_a_magnitude_are_a_number(value: int) -> None:
    assert signed(abs(value) | (1 << 15 if value < 0 else 0), 1 << 15) == value


def test_the_units_of_the_manuals() -> None:
    assert UNITS["dynamixel"].speed_radps == pytest.approx(radians(0.111 * 360 / 60))
    assert 50 * UNITS["feetech"].speed_radps == pytest.approx(radians(0.732 * 360 / 60), rel=1e-3)
    assert [slope_of(counts) for counts in (0.0, 3.0, 30.0, 64.1, 1000.0)] == [2, 4, 32, 64, 128]


# --- the families -----------------------------------------------------------------------------------


@families
def test_registers_do_not_overlap_and_those_that_are_named_are_there(family: ServoFamily) -> None:
    rows = sorted(family.registers.values())
    assert all(one.address + one.size <= other.address for one, other in itertools.pairwise(rows))
    named = {*family.orders, *family.modes, *family.revival, "torque_enable", "torque_limit", "present_position"}
    assert {"model", "id", "baud", "return_delay", "low_limit", "high_limit", *named} <= set(family.registers)


@families
def test_answers_of_a_service_are_told_apart_by_their_length(family: ServoFamily) -> None:
    state = family.block(*STATE)[1]
    mode = family.block(family.modes[0], family.modes[-1])[1]
    assert len({0, READING_LENGTH, state, mode}) == 4  # 0: of a write


@families
def test_the_settings_of_a_joint_are_in_the_block_by_which_they_are_checked(family: ServoFamily) -> None:
    first, length = family.block(*STATE)
    settings = family.settings(Joint("claw", "hand", 8, (-90.0, 90.0), 1.5, 6.0, units=family.units), 0.4)
    assert settings["torque_limit"] == round(0.4 * family.units.full_torque)
    assert all(first <= family.registers[name].address < first + length for name in settings)


def test_orders_are_goal_and_speed_and_for_a_feetech_no_time_between_them() -> None:
    assert DYNAMIXEL.order(0x201, 0x102) == bytes.fromhex("01 02 02 01")
    assert DYNAMIXEL.block(DYNAMIXEL.orders[0], DYNAMIXEL.orders[-1]) == (30, 4)
    assert FEETECH.order(0x801, 0x28C) == bytes.fromhex("01 08 00 00 8C 02")
    assert FEETECH.block(FEETECH.orders[0], FEETECH.orders[-1]) == (42, 6)


def test_what_feetechs_manual_shows_of_its_error_byte() -> None:
    assert FEETECH.errors_in(0x25) == ("voltage", "overheating", "overload")
    assert FEETECH.errors_in(0x0A) == ("position sensor", "current")
    assert find_status(status(4, 0x08, b""), 4, 8, FEETECH.refusals) is None  # it refuses nothing


@pytest.mark.parametrize(
    ("protocol", "count", "angle_deg"),
    [("dynamixel", 0, -150.0), ("dynamixel", 1023, 150.0), ("feetech", 0, -180.0), ("feetech", 3072, 90.0)],
)
def test_a_joints_counts_follow_from_its_networks_protocol(protocol: Protocol, count: int, angle_deg: float) -> None:
    joint = Robot.load().with_networks(protocol=protocol).joints["elbow"]
    assert degrees(joint.to_angle(count)) == pytest.approx(angle_deg)
    assert joint.to_count(radians(angle_deg)) == count
    assert joint.to_count(10.0) == UNITS[protocol].counts - 1
