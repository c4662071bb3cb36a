"""The family of AX and RX servos (ROBOTIS AX-12, RX-28 and RX-64 manuals: the same addresses)."""

from __future__ import annotations

from math import radians

from cocoro.joints import Joint
from services.servos.family import Register, ServoFamily, Signs, kept

REGISTERS: dict[str, Register] = {
    "model": kept(0, 2, writable=False),
    "firmware": kept(2, 1, writable=False),
    "id": kept(3, 1),
    "baud": kept(4, 1),
    "return_delay": kept(5, 1),
    "low_limit": kept(6, 2),
    "high_limit": kept(8, 2),
    "temperature_limit": kept(11, 1),
    "low_voltage": kept(12, 1),
    "high_voltage": kept(13, 1),
    "max_torque": kept(14, 2),
    "status_return": kept(16, 1),
    "alarm_led": kept(17, 1),
    "shutdown": kept(18, 1),
    "torque_enable": Register(24, 1),
    "led": Register(25, 1),
    "cw_margin": Register(26, 1),
    "ccw_margin": Register(27, 1),
    "cw_slope": Register(28, 1),
    "ccw_slope": Register(29, 1),
    "goal_position": Register(30, 2),
    "moving_speed": Register(32, 2),
    "torque_limit": Register(34, 2),
    "present_position": Register(36, 2, writable=False),
    "present_speed": Register(38, 2, writable=False),
    "present_load": Register(40, 2, writable=False),
    "voltage": Register(42, 1, writable=False),
    "temperature": Register(43, 1, writable=False),
    "moving": Register(46, 1, writable=False),
    "lock": Register(47, 1),
    "punch": Register(48, 2),
}

SLOPES = (2, 4, 8, 16, 32, 64, 128)
"""Values of the slope registers: distance from the goal, counts, below which the servo pushes with less than its
limit."""
SIGN = 1 << 10
"""Sign bit of speed and load: set is clockwise, towards smaller positions."""

VOLTAGE, ANGLE_LIMIT, OVERHEATING, RANGE, CHECKSUM, OVERLOAD, INSTRUCTION = (1 << bit for bit in range(7))


def slope_of(compliance_counts: float) -> int:
    """The slope nearest to `compliance_counts` by ratio; the steepest for 0."""
    return min(SLOPES, key=lambda slope: max(slope, compliance_counts) / min(slope, max(compliance_counts, 1.0)))


def settings_of(joint: Joint, torque: float) -> dict[str, int]:
    slope = slope_of(radians(joint.compliance_deg) / joint.units.count_rad)
    return {"cw_slope": slope, "ccw_slope": slope, "torque_limit": round(torque * joint.units.full_torque)}


DYNAMIXEL = ServoFamily(
    protocol="dynamixel",
    registers=REGISTERS,
    models={12: "AX-12", 18: "AX-18", 300: "AX-12W", 10: "RX-10", 24: "RX-24F", 28: "RX-28", 64: "RX-64"},
    orders=("goal_position", "moving_speed"),
    settings=settings_of,
    revival={},  # a shutdown sets the torque limit to 0, and to write it, as the settings do, ends it
    modes=("low_limit", "high_limit"),
    is_wheel=lambda limits: not any(limits),
    signs=Signs(position=(1 << 16, 1023), speed=(SIGN, 1023), load=(SIGN, 1023)),
    wheel_settings={},
    volts=(9.0, 16.0),
    errors={
        VOLTAGE: "voltage",
        ANGLE_LIMIT: "angle limit",
        OVERHEATING: "overheating",
        RANGE: "range",
        CHECKSUM: "checksum",
        OVERLOAD: "overload",
        INSTRUCTION: "instruction",
    },
    refusals=ANGLE_LIMIT | RANGE | CHECKSUM | INSTRUCTION,
    shutdowns=OVERHEATING | OVERLOAD,
)
