"""Answers of servos: found when they are complete, and nothing else is; registers decoded correctly."""

from __future__ import annotations

from math import radians

import pytest
from dynamixel_sdk.protocol1_packet_handler import Protocol1PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from services.servos import table
from services.servos.bus import asked, find_status


def status(number: int, error: int, data: bytes) -> bytes:
    body = bytes([number, len(data) + 2, error]) + data
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


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
    Protocol1PacketHandler().readTx(port, 1, table.REGISTERS["temperature"].address, 1)
    assert port.written == bytes.fromhex("FF FF 01 04 02 2B 01 CC")
    assert asked(port.written) == (1, 1)


def test_the_manuals_example_of_an_answer_is_read() -> None:
    found = find_status(bytes.fromhex("FF FF 01 03 00 20 DB"), 1, 1)
    assert found is not None
    assert (found.error, found.data) == (0, b"\x20")


def test_who_is_asked_for_what() -> None:
    assert asked(bytes.fromhex("FF FF 05 04 03 18 01 DA")) == (5, 0)
    assert asked(bytes.fromhex("FF FF FE 02 05 FA")) is None


@given(STATUS, st.binary(max_size=20), st.binary(max_size=20))
def test_an_answer_is_found_in_whatever_is_around_it(packet: bytes, before: bytes, after: bytes) -> None:
    found = find_status(before + packet + after, packet[2], 8)
    assert found is not None
    assert found.packet in before + packet + after


@given(STATUS, st.data())
def test_a_changed_or_missing_byte_never_gets_through(packet: bytes, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(packet) - 1))
    changed = packet[:at] + bytes([packet[at] ^ data.draw(st.integers(1, 255))]) + packet[at + 1 :]
    assert find_status(changed, packet[2], 8) is None
    assert find_status(packet[:at] + packet[at + 1 :], packet[2], 8) is None


@given(STATUS)
def test_another_servos_answer_or_one_of_another_length_is_none(packet: bytes) -> None:
    assert find_status(packet, (packet[2] + 1) % 254, 8) is None
    assert find_status(packet, packet[2], 2) is None


def test_a_refusal_comes_without_data_and_a_late_confirmation_is_no_refusal() -> None:
    refusal = find_status(status(4, 0x08, b""), 4, 8)
    assert refusal is not None
    assert table.errors_in(refusal.error) == ("range",)
    assert find_status(status(4, 0, b""), 4, 8) is None
    assert find_status(status(4, 0x20, b""), 4, 8) is None


@given(st.binary(max_size=300), st.integers(0, 253), st.integers(0, 20))
def test_rubbish_is_no_answer(rubbish: bytes, number: int, length: int) -> None:
    found = find_status(rubbish, number, length)
    if found is not None:
        assert found.packet in rubbish
        assert ~sum(found.packet[2:-1]) & 0xFF == found.packet[-1]


def test_a_reading_is_what_the_registers_say() -> None:
    data = bytes([0x20, 0x01, 0x0A, 0x00, 0x64, 0x04, 120, 45])
    reading = table.reading(data, 0, 7)
    assert reading == table.ServoReading(0x120, 10, -100, 12.0, 45, 0, 7)


@pytest.mark.parametrize("at", [1, 3, 5])
def test_a_reading_that_no_servo_can_measure_is_none(at: int) -> None:
    data = bytearray(8)
    data[at] = 0xF0
    assert table.reading(bytes(data), 0, 0) is None


def test_the_units_of_the_manual() -> None:
    assert pytest.approx(radians(0.111 * 360 / 60)) == table.SPEED_RADPS
    assert table.baud_of(1) == 1_000_000
    assert table.baud_of(34) == 57_143
    assert [table.slope_of(counts) for counts in (0.0, 3.0, 30.0, 64.1, 1000.0)] == [2, 4, 32, 64, 128]
    assert (table.signed(0), table.signed(5), table.signed(1029)) == (0, 5, -5)
