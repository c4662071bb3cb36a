"""The emulated Feetech servos answer as the manuals say."""

from __future__ import annotations

import pytest

from sim.wire.emulator import SimplePlant
from sim.wire.feetech import EmulatedFeetech
from sim.wire.servo import EmulatedServoBus

BAUD = 1_000_000
MS = 1_000_000
TORQUE, GOAL, SPEED, LOCK = 40, 42, 46, 55
OVERLOAD = 0x20


def packet(number: int, instruction: int, *data: int) -> bytes:
    body = bytes([number, len(data) + 2, instruction, *data])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def word(value: int) -> tuple[int, int]:
    return value & 0xFF, value >> 8


class Wire:
    """Servos and a plant, with direct access to their bytes."""

    def __init__(self, *servos: EmulatedFeetech) -> None:
        self.servos = servos or (EmulatedFeetech(1),)
        self.bus = EmulatedServoBus(self.servos)
        self.plant = SimplePlant(None, self.bus)
        self.now_ns = 0
        self.wait(0)

    def say(self, data: bytes, baud: int = BAUD) -> bytes:
        self.now_ns += MS
        self.bus.receive(data, baud, self.now_ns)
        return self.bus.advance(baud, self.now_ns)

    def write(self, address: int, *data: int, number: int = 1) -> bytes:
        return self.say(packet(number, 3, address, *data))

    def wait(self, ms: int) -> None:
        for _ in range(0, ms + 1, 10):
            self.now_ns += 10 * MS
            self.plant.advance(self.now_ns)


def test_the_manuals_ping_and_a_read_of_the_position() -> None:
    wire = Wire()
    assert wire.say(bytes.fromhex("FF FF 01 02 01 FB")) == bytes.fromhex("FF FF 01 02 00 FC")
    assert wire.say(bytes.fromhex("FF FF 01 04 02 38 02 BE")) == bytes.fromhex("FF FF 01 04 00 00 08 F2")  # 2048


def test_its_model_is_777() -> None:
    assert Wire().say(packet(1, 2, 3, 2)) == packet(1, 0, *word(777))


def test_a_sync_write_moves_two_servos_at_their_speeds_and_nobody_answers() -> None:
    wire = Wire(EmulatedFeetech(1), EmulatedFeetech(2))
    orders = (1, *word(2148), 0, 0, *word(500), 2, *word(1048), 0, 0, *word(1000))
    assert wire.say(packet(254, 0x83, GOAL, 6, *orders)) == b""
    wire.wait(100)
    assert [servo.get(56) for servo in wire.servos] == pytest.approx([2098, 1948], abs=12)
    assert [servo.get(58) for servo in wire.servos] == [500, 1000 | 1 << 15]
    wire.wait(1000)
    assert [servo.get(56) for servo in wire.servos] == [2148, 1048]


def test_what_is_damaged_unknown_or_out_of_range_is_not_obeyed_and_not_told() -> None:
    wire = Wire()
    assert wire.say(packet(1, 3, TORQUE, 1)[:-1] + b"\x00") == b""
    assert wire.say(packet(1, 9)) == b""
    assert wire.say(packet(1, 2, 70, 100)) == b""
    assert wire.write(48, *word(1001)) == packet(1, 0)
    assert wire.write(56, 0, 1) == packet(1, 0)
    assert [wire.servos[0].get(address) for address in (TORQUE, 48, 56)] == [0, 1000, 2048]


def test_a_goal_written_to_a_limp_servo_makes_it_hold() -> None:
    wire = Wire()
    assert not wire.servos[0].motor.on
    wire.write(GOAL, *word(2048))
    assert wire.servos[0].motor.on


def test_it_goes_no_further_than_its_limits() -> None:
    wire = Wire()
    wire.write(11, *word(2100))
    wire.write(GOAL, *word(3000))
    wire.wait(2000)
    assert wire.servos[0].get(56) == 2100


def test_what_is_written_below_40_lasts_only_if_the_lock_was_off() -> None:
    wire = Wire()
    servo = wire.servos[0]
    wire.write(16, *word(500))
    assert servo.get(16) == 500
    servo.power_up()
    assert (servo.get(16), servo.get(48)) == (1000, 1000)
    wire.write(LOCK, 0)
    wire.write(16, *word(500))
    servo.power_up()
    assert (servo.get(16), servo.get(48), servo.get(LOCK)) == (500, 500, 1)


def test_power_that_comes_back_finds_a_limp_servo_where_it_was() -> None:
    wire = Wire()
    wire.write(GOAL, *word(1000))
    wire.wait(2000)
    wire.servos[0].power_up()
    assert [wire.servos[0].get(address) for address in (5, TORQUE, 41, SPEED, 56)] == [1, 0, 0, 0, 1000]


def test_as_a_wheel_it_turns_at_its_speed_past_the_end_of_its_range_until_the_speed_is_0() -> None:
    wire = Wire()
    servo = wire.servos[0]
    wire.write(33, 1)
    wire.write(TORQUE, 1)
    wire.write(SPEED, *word(1000 | 1 << 15))
    wire.wait(3000)
    assert servo.shaft == pytest.approx(2048 - 3000, abs=30)
    assert servo.get(56) == servo.shaft % 4096
    assert servo.get(58) == 1000 | 1 << 15
    wire.write(SPEED, 0, 0)
    wire.wait(20)
    at = servo.shaft
    wire.wait(500)
    assert (servo.shaft, servo.get(58)) == (at, 0)


def test_an_overload_leaves_a_fifth_of_the_torque_until_the_torque_is_switched_off() -> None:
    wire = Wire()
    servo = wire.servos[0]
    wire.plant.blocked.add(1)
    wire.write(GOAL, *word(3000))
    wire.wait(1900)
    assert (servo.error, servo.get(60), servo.motor.limit) == (0, 1000, 1.0)
    wire.wait(200)
    assert wire.say(packet(1, 1))[4] == OVERLOAD
    assert (servo.get(TORQUE), servo.get(48), servo.motor.limit) == (1, 1000, 0.2)
    wire.write(48, *word(1000))
    wire.write(GOAL, *word(2048))
    assert servo.error == OVERLOAD
    wire.write(TORQUE, 0)
    wire.write(TORQUE, 1)
    assert (servo.error, servo.motor.limit) == (0, 1.0)


def test_a_hot_servo_lets_go_and_says_so_and_pushes_again_when_it_has_cooled() -> None:
    wire = Wire()
    servo = wire.servos[0]
    wire.write(TORQUE, 1)
    servo.put(63, 71)
    assert wire.say(packet(1, 1))[4] == 0x04
    assert not servo.motor.on
    servo.put(63, 60)
    assert wire.say(packet(1, 1))[4] == 0
    assert servo.motor.on


def test_128_makes_the_place_where_it_is_the_middle() -> None:
    wire = Wire()
    servo = wire.servos[0]
    wire.plant.turn_by_hand(1, 100)
    wire.wait(10)
    assert servo.get(56) == 100
    wire.write(LOCK, 0)
    wire.write(TORQUE, 128)
    assert (servo.get(56), servo.get(31)) == (2048, 1948 | 1 << 11)
    wire.write(GOAL, *word(2148))
    wire.wait(1000)
    assert (servo.get(56), servo.shaft) == (2148, 200)
    servo.power_up()
    assert servo.get(56) == 2148


def test_baud_id_level_and_return_delay_are_what_the_registers_say() -> None:
    wire = Wire()
    wire.write(5, 7)
    assert wire.say(packet(1, 1)) == b""
    wire.write(6, 4, number=7)
    assert wire.say(packet(7, 1)) == b""
    assert wire.say(packet(7, 1), 115_200) == packet(7, 0)
    wire.servos[0].put(7, 250)
    assert wire.say(packet(7, 1), 115_200) == b""
    wire.now_ns += MS
    assert wire.bus.advance(115_200, wire.now_ns) == packet(7, 0)
    wire.servos[0].put(7, 0)
    wire.servos[0].put(8, 0)
    assert wire.say(packet(7, 3, TORQUE, 1), 115_200) == b""
    assert wire.say(packet(7, 2, TORQUE, 1), 115_200) == packet(7, 0, 1)
