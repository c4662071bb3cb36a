"""The checks of `cocoro doctor` for the base, while its service is down."""

from __future__ import annotations

import time

import serial

from cocoro.checks import Check, bad, note, ok
from cocoro.ports import check_port, port_path
from cocoro.robot import Robot
from services.base import oi
from services.base.driver import BATTERY_LOW
from services.base.service import BaseConfig

__all__ = ["check"]

ASKED = (oi.MODE, oi.VOLTAGE, oi.CHARGE, oi.CAPACITY, oi.CHARGING, oi.BUMPS)
ANSWER_S = 0.5


def check(config: BaseConfig, robot: Robot, robot_name: str) -> list[Check]:
    checks = check_port("Create", config.port, robot_name, quick=False)
    return checks if checks[0].state != "ok" else [*checks, *_talk(port_path(config.port, robot_name))]


def _talk(path: str) -> list[Check]:
    """Wake the Create and query it. It stays in passive mode, in which it does not move."""
    try:
        with serial.Serial(path, oi.BAUD, timeout=ANSWER_S, exclusive=True) as port:
            port.write(oi.start())
            time.sleep(0.05)  # what it was still sending arrives meanwhile, and is discarded
            port.reset_input_buffer()
            port.write(oi.query(ASKED))
            data = port.read(oi.length(ASKED) - len(ASKED))
    except OSError as error:
        return [note("Create", f"{path} cannot be opened ({error}): does its service run? See `cocoro base`")]
    readings = oi.answer(data, ASKED)
    if readings is None:
        return [bad("Create", "it does not answer: switch it on (its light is on), and check the cable")]
    volts = readings[oi.VOLTAGE] / 1000.0
    share = readings[oi.CHARGE] / readings[oi.CAPACITY] if readings[oi.CAPACITY] else 0.0
    charging = ", charging" if readings[oi.CHARGING] in oi.CHARGES else ""
    text = f"{100 * share:.0f}%, {volts:.1f} V{charging}"
    battery = ok("battery", text) if share >= BATTERY_LOW else bad("battery", f"{text}: charge it")
    checks = [ok("Create", f"answers, {oi.MODES[readings[oi.MODE]]} mode"), battery]
    if readings[oi.BUMPS] & oi.WHEEL_DROPS:
        checks.append(bad("wheels", "a wheel hangs in the air: put the robot on the floor"))
    return checks
