"""What is done with servos by hand, while the service is down: find them, number them, measure their zeros and limits.

The commands are `cocoro servos ...`; whoever calls gives the questions' answers and takes what is to be told.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from math import degrees, radians
from typing import NamedTuple

from serial.tools import list_ports

from cocoro.errors import CocoroError, RefusedError
from cocoro.robot import SERVO_COUNT_RAD, Joint
from services.servos import table
from services.servos.bus import PortError, RefusedWriteError, ServoBus, SilentError

BAUDS = (1_000_000, 57_600, 115_200, 500_000, 2_000_000, 9_600)
"""In the order in which one meets them."""
SCAN_S = 0.02
READINGS = 20
MARGIN_DEG = 2.0
"""Kept from the ends that were felt by hand."""
TURNED_COUNTS = 20
"""Less than this is no turn by hand."""

Tell = Callable[[str], None]
Ask = Callable[[str], None]
"""Shows a sentence, and returns when the operator has done what it says."""


class FoundServo(NamedTuple):
    """A servo on a port."""

    port: str
    baud: int
    number: int
    model: str
    return_delay_us: int
    position: int
    voltage_v: float
    temperature_c: int
    errors: tuple[str, ...]


def candidates() -> list[str]:
    """Serial ports that may be a servo adapter."""
    ports = [port.device for port in list_ports.comports() if port.vid is not None]
    return sorted(ports)


def scan(ports: Iterable[str], bauds: Iterable[int], numbers: Iterable[int], tell: Tell) -> Iterator[FoundServo]:
    """Ask every number at every rate. A port that cannot be opened is told of and passed over."""
    wanted = list(numbers)
    for port in ports:
        for baud in bauds:
            try:
                with ServoBus(port, baud, SCAN_S) as bus:
                    tell(f"{port} at {baud} baud ...")
                    for number in wanted:
                        if bus.ping(number) is not None:
                            yield look_at(bus, baud, number)
            except PortError as error:
                tell(str(error))
                break


def look_at(bus: ServoBus, baud: int, number: int) -> FoundServo:
    """Everything that one wants to know first of a servo. Raises SilentError."""
    model = bus.read(number, "model")
    reading = bus.reading(number)
    return FoundServo(
        bus.path,
        baud,
        number,
        table.MODELS.get(model, f"model {model}"),
        2 * bus.read(number, "return_delay"),
        reading.position,
        reading.voltage_v,
        reading.temperature_c,
        table.errors_in(reading.error),
    )


def set_number(bus: ServoBus, old: int, new: int) -> None:
    """Give a servo another ID, and no return delay. Raises RefusedError when the new one is taken, or the old one is
    silent (or there are two of it: then they talk over each other)."""
    if bus.ping(old) is None:
        raise RefusedError(f"nobody answers as {old}: is it alone on the line, powered, and at this baud rate?")
    if new != old:
        if bus.ping(new) is not None:
            raise RefusedError(f"there is a servo {new} on this line already; take it off first")
        with suppress(SilentError):  # it may answer by its new name already
            bus.write(old, "id", new)
        if bus.ping(new) is None:
            raise RefusedError(f"the servo does not answer as {new}; `cocoro servos scan` tells what it is now")
    bus.write(new, "return_delay", 0)


def relax(bus: ServoBus, joint: Joint) -> None:
    try:
        bus.write(joint.id, "torque_enable", 0)
    except SilentError as error:
        raise RefusedError(f"{joint.name} (ID {joint.id}) does not answer on {bus.path}") from error


def position_of(bus: ServoBus, joint: Joint) -> float:
    """Its mean position over a moment. Raises RefusedError when it moves meanwhile."""
    positions = []
    for _ in range(READINGS):
        positions.append(bus.reading(joint.id).position)
        time.sleep(0.01)  # the readings span a while, in which an unsteady hand shows
    if max(positions) - min(positions) > TURNED_COUNTS:
        raise RefusedError(f"{joint.name} moved while it was measured; hold it still")
    return sum(positions) / len(positions)


def calibrate(bus: ServoBus, joint: Joint, at_deg: float, ask: Ask) -> dict[str, float | int]:
    """Where a joint's zero is and which way it turns: guided by hand to a known angle, then towards greater angles.
    The values of its [[joint]] row. Raises RefusedError."""
    relax(bus, joint)
    ask(f"{joint.name}: turn it to {at_deg:g} degrees by hand, and hold it there")
    there = position_of(bus, joint)
    ask(f"{joint.name}: now turn it some way towards greater angles")
    turned = position_of(bus, joint) - there
    if abs(turned) < TURNED_COUNTS:
        raise RefusedError(f"{joint.name} was turned by {abs(turned) * degrees(SERVO_COUNT_RAD):.1f} degrees only")
    direction = 1 if turned > 0 else -1
    centre = there - direction * at_deg / degrees(SERVO_COUNT_RAD)
    return {"direction": direction, "centre_count": round(centre, 2)}


def feel_limits(bus: ServoBus, joint: Joint, done: Callable[[], bool], tell: Tell) -> tuple[float, float]:
    """The ends between which somebody turns a limp joint until `done`, in degrees, with a margin. Raises
    RefusedError when it was hardly turned."""
    relax(bus, joint)
    low, high = 1023, 0
    while not done():
        try:
            position = bus.reading(joint.id).position
        except SilentError:
            continue
        if position < low or position > high:
            low, high = min(low, position), max(high, position)
            ends = sorted(degrees(joint.to_angle(count)) for count in (low, high))
            tell(f"{joint.name}: {ends[0]:.1f} to {ends[1]:.1f} degrees")
    if high - low < 2 * TURNED_COUNTS:
        raise RefusedError(f"{joint.name} was hardly turned; nothing is changed")
    first, last = sorted(degrees(joint.to_angle(count)) for count in (low, high))
    return round(first + MARGIN_DEG, 1), round(last - MARGIN_DEG, 1)


def write_limits(bus: ServoBus, joint: Joint, limits_deg: tuple[float, float]) -> tuple[int, int]:
    """Put a joint's limits into its servo too, which then refuses goals beyond them; the two positions."""
    ends = sorted(joint.to_count(radians(limit)) for limit in limits_deg)
    try:
        bus.write(joint.id, "cw_limit", ends[0])
        bus.write(joint.id, "ccw_limit", ends[1])
    except (SilentError, RefusedWriteError) as error:
        raise CocoroError(f"{joint.name}: {error}") from error
    return ends[0], ends[1]
