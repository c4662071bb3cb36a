"""Which servos are emulated on which line."""

from __future__ import annotations

from cocoro.errors import ConfigError
from cocoro.joints import Group, Joint, ServoPlace
from cocoro.robot import Robot
from cocoro.servo_units import Protocol
from sim.wire.dynamixel import EmulatedDynamixel
from sim.wire.feetech import EmulatedFeetech
from sim.wire.servo import EmulatedServo

WHEEL_OVERLOAD_S = 2.0
"""Time at its limit after which the servo of a wheel shuts down, as from the factory."""
OTHERS = ("create", "control")
"""What stands beside the lines' ports: the Create's port, and the socket of `sim.wire.control`."""


def servos_on_lines(robot: Robot) -> dict[str, tuple[Protocol, list[Joint]]]:
    """By line, what its servos speak, and their joints; wheels are not among them. Raises ConfigError for a line that
    is called as what stands beside its port, and for servos that have one ID, by which the emulation tells those of all
    lines apart."""
    if taken := sorted(set(OTHERS) & set(robot.networks)):
        raise ConfigError(f"network {taken[0]}: no line of this name can be emulated, choose another one")
    lines = dict[str, tuple[Protocol, list[Joint]]]()
    by_number = dict[int, Joint | ServoPlace]({wheel.id: wheel for wheel in robot.base.servo_places})
    for line, network in robot.networks.items():
        lines[line] = network.protocol, [robot.joints[name] for name in robot.network_joints(line)]
        for joint in lines[line][1]:
            if (other := by_number.setdefault(joint.id, joint)) is not joint:
                raise ConfigError(f"joints {other.name} and {joint.name} have the ID {joint.id}: not emulated")
    return lines


def model_of(group: Group | None, protocol: Protocol) -> int:
    """The model number of the servos of a group's joints: an RX-28 in the arm and an AX-12 elsewhere, or an STS3215."""
    if protocol == "feetech":
        return 777
    return 28 if group == "arm" else 12


def servo_of(model: int, number: int, overload_s: float) -> EmulatedServo:
    """A servo of this model. Raises ValueError when none is emulated."""
    for family in (EmulatedDynamixel, EmulatedFeetech):
        if model in family.MODELS:
            return family(number, model, overload_s)
    raise ValueError(f"no servo of model {model} is emulated")


def wheel_of(place: ServoPlace, protocol: Protocol) -> EmulatedServo:
    """The servo of a wheel, set up as one. Raises ValueError when none is emulated."""
    servo = servo_of(model_of(None, protocol), place.id, WHEEL_OVERLOAD_S)
    servo.be_wheel()
    return servo
