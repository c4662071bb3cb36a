"""Which servos are emulated on a network."""

from __future__ import annotations

from cocoro.servo_units import Protocol
from sim.wire.dynamixel import EmulatedDynamixel
from sim.wire.feetech import EmulatedFeetech
from sim.wire.servo import EmulatedServo


def model_of(network: str, protocol: Protocol) -> int:
    """The model number of a network's servos: an RX-28 in the arm and an AX-12 elsewhere, or an STS3215."""
    if protocol == "feetech":
        return 777
    return 28 if network == "arm" else 12


def servo_of(model: int, number: int, overload_s: float) -> EmulatedServo:
    """A servo of this model. Raises ValueError when none is emulated."""
    for family in (EmulatedDynamixel, EmulatedFeetech):
        if model in family.MODELS:
            return family(number, model, overload_s)
    raise ValueError(f"no servo of model {model} is emulated")
