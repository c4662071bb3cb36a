"""The families of servos by the protocol that a line's description names."""

from __future__ import annotations

from cocoro.servo_units import Protocol
from services.servos.dynamixel import DYNAMIXEL
from services.servos.family import ServoFamily
from services.servos.feetech import FEETECH

FAMILIES: dict[Protocol, ServoFamily] = {family.protocol: family for family in (DYNAMIXEL, FEETECH)}
