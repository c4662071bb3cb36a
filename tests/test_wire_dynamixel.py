"""The emulated servos answer as the manual says."""

from __future__ import annotations

import pytest

from sim.wire.dynamixel import EmulatedDynamixel
from sim.wire.servo import EmulatedServo, EmulatedServoBus

BAUD = 1_000_000
MS = 1_000_000


def packet(number: int, instruction: int, *data: int) -> bytes:
    body = bytes([number, len(data) + 2, instruction, *data])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


class Wire:
    def __init__(self, *servos: EmulatedServo) -> None:
        self.bus = EmulatedServoBus(servos)
        self.now_ns = 0

    def say(self, data: bytes, baud: int = BAUD) -> bytes:
        self.now_ns += MS
        self.bus.receive(data, baud, self.now_ns)
        return self.bus.advance(baud, self.now_ns)


def test_the_manuals_read_of_the_temperature() -> None:
    servo = EmulatedDynamixel(1)
    servo.put(43, 32)
    assert Wire(servo).say(bytes.fromhex("FF FF 01 04 02 2B 01 CC")) == bytes.fromhex("FF FF 01 03 00 20 DB")


def test_the_manuals_ping() -> None:
    assert Wire(EmulatedDynamixel(1)).say(bytes.fromhex("FF FF 01 02 01 FB")) == bytes.fromhex("FF FF 01 02 00 FC")


def test_the_manuals_sync_write_moves_four_servos_and_nobody_answers() -> None:
    wire = Wire(*(EmulatedDynamixel(number) for number in range(4)))
    data = "FF FF FE 18 83 1E 04 00 10 00 50 01 01 20 02 60 03 02 30 00 70 01 03 20 02 80 03 12"
    assert wire.say(bytes.fromhex(data)) == b""
    moves = [(servo.get(30), servo.get(32)) for servo in wire.bus.servos]
    assert moves == [(0x010, 0x150), (0x220, 0x360), (0x030, 0x170), (0x220, 0x380)]


def test_a_wrong_checksum_is_answered_as_such_and_not_obeyed() -> None:
    wire = Wire(EmulatedDynamixel(1))
    answer = wire.say(packet(1, 3, 25, 1)[:-1] + b"\x00")
    assert answer[4] == 0x10
    assert wire.bus.servos[0].get(25) == 0


def test_read_only_and_out_of_range_are_refused_whole() -> None:
    wire = Wire(EmulatedDynamixel(1))
    servo = wire.bus.servos[0]
    assert wire.say(packet(1, 3, 36, 0, 1))[4] == 0x08
    assert wire.say(packet(1, 3, 24, 1, 2))[4] == 0x08  # the LED knows 0 and 1
    assert servo.get(24) == 0
    servo.put(8, 800)
    assert wire.say(packet(1, 3, 30, 0xFF, 3))[4] == 0x02  # beyond the angle limit
    assert servo.get(30) == 512


def test_a_goal_written_to_a_limp_servo_makes_it_hold() -> None:
    wire = Wire(EmulatedDynamixel(1))
    assert not wire.bus.servos[0].motor.on
    wire.say(packet(1, 3, 30, 0, 1))
    assert wire.bus.servos[0].motor.on


def test_registered_writes_wait_for_the_action() -> None:
    wire = Wire(EmulatedDynamixel(1), EmulatedDynamixel(2))
    wire.say(packet(1, 4, 25, 1))
    wire.say(packet(2, 4, 25, 1))
    assert [servo.get(25) for servo in wire.bus.servos] == [0, 0]
    assert wire.say(packet(254, 5)) == b""
    assert [servo.get(25) for servo in wire.bus.servos] == [1, 1]


def test_an_overload_lets_go_until_the_torque_limit_is_written_again() -> None:
    wire = Wire(EmulatedDynamixel(1))
    servo = wire.bus.servos[0]
    servo.put(24, 1)
    for tick in range(60):
        servo.sense(512, 0, -1.0, tick * 100 * MS)
    assert wire.say(packet(1, 1))[4] == 0x20
    assert (servo.get(24), servo.get(34)) == (0, 0)
    wire.say(packet(1, 3, 34, 0xFF, 3))
    assert wire.say(packet(1, 1))[4] == 0


@pytest.mark.parametrize(("address", "value", "bit"), [(42, 50, 0x01), (43, 100, 0x04)])
def test_voltage_and_heat_show_in_every_answer(address: int, value: int, bit: int) -> None:
    wire = Wire(EmulatedDynamixel(1))
    wire.bus.servos[0].put(address, value)
    answer = wire.say(packet(1, 1))
    if address == 42:
        assert answer == b""  # at 5 V nothing answers
        wire.bus.servos[0].put(42, 145)
        answer = wire.say(packet(1, 1))
    assert answer[4] == bit


def test_baud_id_and_return_delay_are_what_the_registers_say() -> None:
    wire = Wire(EmulatedDynamixel(1))
    wire.say(packet(1, 3, 3, 7))
    assert wire.say(packet(1, 1)) == b""
    wire.say(packet(7, 3, 4, 34))  # 57142
    assert wire.say(packet(7, 1)) == b""
    assert wire.say(packet(7, 1), 57143) == packet(7, 0)
    wire.bus.servos[0].put(5, 250)
    assert wire.say(packet(7, 1), 57143) == b""
    wire.now_ns += MS
    assert wire.bus.advance(57143, wire.now_ns) == packet(7, 0)


def test_two_of_one_id_talk_over_each_other() -> None:
    one, other = EmulatedDynamixel(1), EmulatedDynamixel(1)
    one.put(43, 0x0F)
    other.put(43, 0xF0)
    answer = Wire(one, other).say(packet(1, 2, 43, 1))
    assert answer[5] == 0x00
    assert ~sum(answer[2:-1]) & 0xFF != answer[-1]


def test_rubbish_before_and_between_packets_is_passed_over() -> None:
    wire = Wire(EmulatedDynamixel(1))
    assert wire.say(b"\x00\xff\x13" + packet(1, 1)) == packet(1, 0)
    assert wire.say(b"\xff\xff\xff" + packet(1, 1)[2:]) == packet(1, 0)
    assert wire.say(b"\xff\xff\x01\x09") == b""
    wire.now_ns += 200 * MS  # a packet that stops in the middle is given up
    assert wire.say(packet(1, 1)) == packet(1, 0)


def test_power_that_comes_back_finds_a_limp_servo_with_its_id() -> None:
    servo = EmulatedDynamixel(5)
    servo.put(24, 1)
    servo.put(32, 50)
    servo.put(36, 300)
    servo.power_up()
    assert (servo.number, servo.get(24), servo.get(32), servo.get(36)) == (5, 0, 0, 300)
