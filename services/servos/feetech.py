"""The family of Feetech's STS servos with a magnetic encoder, such as the STS3215 of the SO-101 arm.

Sources: Feetech's memory table of the STS series and its protocol manual, and the constants of its own SDK. They differ
from a Dynamixel in what a driver must know:

- The error byte says how the servo is, never that it refuses: a value that it does not take is not told.
- What is written below address 40 is lost with the power, unless the lock is 0 meanwhile.
- There is no compliance: the gains of its loop, which are in its kept memory, stay as they are.
- After an overload (by default 2 s above 80 % of its torque) it pushes with 20 % and says so, although its torque is
  still enabled and its limit the same. The manuals leave open what ends this. To switch the torque off and on does.
- A servo in mode 1 is a wheel: it turns at its speed for ever, in place of going to its goal at that speed. The speed
  has its sign in bit 15 and counts steps per second, 4096 a turn. Its position goes on from 4095 to 0. No register ends
  that when nothing is heard any more: the table has no time limit of the communication.
"""

from __future__ import annotations

from cocoro.joints import Joint
from cocoro.servo_units import UNITS
from services.servos.family import Register, ServoFamily, Signs, kept

REGISTERS: dict[str, Register] = {
    "firmware": kept(0, 2, writable=False),
    "model": kept(3, 2, writable=False),
    "id": kept(5, 1),
    "baud": kept(6, 1),
    "return_delay": kept(7, 1),
    "status_return": kept(8, 1),
    "low_limit": kept(9, 2),
    "high_limit": kept(11, 2),
    "temperature_limit": kept(13, 1),
    "high_voltage": kept(14, 1),
    "low_voltage": kept(15, 1),
    "max_torque": kept(16, 2),
    "phase": kept(18, 1),
    "shutdown": kept(19, 1),
    "alarm_led": kept(20, 1),
    "offset": kept(31, 2),
    "mode": kept(33, 1),
    "protective_torque": kept(34, 1),
    "protection_time": kept(35, 1),
    "overload_torque": kept(36, 1),
    "torque_enable": Register(40, 1),
    "acceleration": Register(41, 1),
    "goal_position": Register(42, 2),
    "goal_time": Register(44, 2),
    "moving_speed": Register(46, 2),
    "torque_limit": Register(48, 2),
    "lock": Register(55, 1),
    "present_position": Register(56, 2, writable=False),
    "present_speed": Register(58, 2, writable=False),
    "present_load": Register(60, 2, writable=False),
    "voltage": Register(62, 1, writable=False),
    "temperature": Register(63, 1, writable=False),
    "status": Register(65, 1, writable=False),
    "moving": Register(66, 1, writable=False),
    "current": Register(69, 2, writable=False),
}

CENTRE_HERE = 128
"""Written into `torque_enable`, it makes the present position 2048, by the register `offset`."""
ACCELERATION = 254
"""The highest one, 25,400 steps/s^2: the motion of a joint is shaped before it gets here. At power-up it is 0, by which
a servo is known whose power failed for a moment."""
FAST_STEPS = 8191
"""Steps a second: twice what the fastest STS does without load."""

VOLTAGE, SENSOR, OVERHEATING, CURRENT, _, OVERLOAD = (1 << bit for bit in range(6))


def settings_of(joint: Joint, torque: float) -> dict[str, int]:
    return {"acceleration": ACCELERATION, "torque_limit": round(torque * joint.units.full_torque)}


FEETECH = ServoFamily(
    protocol="feetech",
    registers=REGISTERS,
    models={777: "STS3215", 2825: "STS3250"},
    orders=("goal_position", "goal_time", "moving_speed"),
    settings=settings_of,
    revival={"torque_enable": 0},
    modes=("mode",),
    is_wheel=any,
    signs=Signs(position=(1 << 15, 32767), speed=(1 << 15, FAST_STEPS), load=(1 << 10, 1023)),
    wheel_settings={"acceleration": ACCELERATION, "torque_limit": UNITS["feetech"].full_torque},
    volts=(4.0, 14.0),  # of all variants: one for 7.4 V cannot be told from one for 12 V
    errors={
        VOLTAGE: "voltage",
        SENSOR: "position sensor",
        OVERHEATING: "overheating",
        CURRENT: "current",
        OVERLOAD: "overload",
    },
    refusals=0,
    shutdowns=SENSOR | OVERHEATING | CURRENT | OVERLOAD,
    lock="lock",
    centring=("torque_enable", CENTRE_HERE),
)
