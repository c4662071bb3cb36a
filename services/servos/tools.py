"""Manual work on servos while their service is down: find them, set their IDs, measure zeros and limits.

The commands are `cocoro servos ...`. `show` displays a line to the operator; `prompt` displays an instruction, and
returns when the operator has carried it out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from math import degrees, inf, pi, radians
from typing import NamedTuple

from serial.tools import list_ports

from cocoro.errors import CocoroError, RefusedError
from cocoro.joints import Joint
from cocoro.servo_units import Protocol
from services.servos.bus import PortError, RefusedWriteError, ServoBus, SilentError
from services.servos.families import FAMILIES

BAUDS = (1_000_000, 57_600, 115_200, 500_000, 2_000_000, 9_600, 38_400, 250_000, 128_000, 76_800)
"""Baud rates, most common first, and last what some adapters do not have."""
SCAN_S = 0.02
READINGS = 20
TRIES = 3
"""So often a tool asks a servo that does not answer. A scan asks once: most of the IDs that it asks are not there."""
MARGIN_DEG = 2.0
"""Margin between the measured ends of a joint and its limits."""
TURNED_RAD = radians(5.8)
"""A joint counts as turned by hand when its position changed by this much."""


class FoundServo(NamedTuple):
    """A servo that was found on a port."""

    port: str
    baud: int
    number: int
    protocol: Protocol
    model: str
    return_delay_us: int
    position: int
    voltage_v: float
    temperature_c: int
    errors: tuple[str, ...]
    is_wheel: bool
    """Whether it turns endlessly, instead of going to a goal."""


def candidates() -> list[str]:
    """Serial ports that may be servo adapters."""
    ports = [port.device for port in list_ports.comports() if port.vid is not None]
    return sorted(ports)


def scan(
    ports: Iterable[str], bauds: Iterable[int], numbers: Iterable[int], show: Callable[[str], None]
) -> Iterator[FoundServo]:
    """Try every ID at every baud rate. A port that cannot be opened is reported and skipped."""
    wanted = list(numbers)
    for port in ports:
        for baud in bauds:
            try:
                with ServoBus(port, baud, SCAN_S) as bus:
                    show(f"{port} at {baud} baud ...")
                    for number in wanted:
                        if recognise(bus, number):
                            yield examine(bus, baud, number)
            except PortError as error:
                show(str(error))
                break


def recognise(bus: ServoBus, number: int) -> bool:
    """Whether a servo answers as `number`. The bus then is of its family: of the one that knows its model, or else of
    the only one in whose register it has this ID. Otherwise the bus's family stays as it was."""
    at_first, likely = bus.family, []
    try:
        for bus.family in FAMILIES.values():
            if bus.read(number, "model") in bus.family.models:
                return True
            if bus.read(number, "id") == number:
                likely.append(bus.family)
    except SilentError:
        bus.family = at_first
        return False
    bus.family = likely[0] if len(likely) == 1 else at_first
    return True


def examine(bus: ServoBus, baud: int, number: int) -> FoundServo:
    """Read the basic data of a servo of the bus's family. Raises SilentError."""
    model = bus.read(number, "model")
    reading = bus.reading(number)
    return FoundServo(
        bus.path,
        baud,
        number,
        bus.family.protocol,
        bus.family.models.get(model, f"model {model}"),
        2 * bus.read(number, "return_delay"),
        reading.position,
        reading.voltage_v,
        reading.temperature_c,
        bus.family.errors_in(reading.error),
        bus.is_wheel(number),
    )


def set_number(bus: ServoBus, old: int, new: int) -> None:
    """Give a servo of any family another ID, and a return delay of 0. Raises RefusedError when the new ID is taken, or
    when no servo answers as the old one; two servos with one ID talk over each other, and seem silent."""
    if not recognise(bus, old):
        raise RefusedError(f"no servo answers as {old}: is it alone on the line, powered, and at this baud rate?")
    if new != old:
        if bus.ping(new) is not None:
            raise RefusedError(f"there is a servo {new} on this line already; take it off first")
        with suppress(SilentError, RefusedWriteError):  # whether it has it is asked next
            bus.keep(old, "id", new)
        if bus.ping(new) is None:
            raise RefusedError(f"the servo does not answer as {new}; `cocoro servos scan` shows its ID")
    bus.keep(new, "return_delay", 0)


def set_wheel(bus: ServoBus, number: int, *, turns: bool) -> None:
    """Set a servo up as a wheel, which turns endlessly, or as a joint again; it is limp afterwards. Raises RefusedError
    when no servo answers as that number, and for a servo of a family that is not driven as a wheel."""
    if not recognise(bus, number):
        raise RefusedError(f"no servo answers as {number}: is it powered, and at this baud rate?")
    if "mode" not in bus.family.registers:
        raise RefusedError(f"servo {number} speaks {bus.family.protocol}: only Feetech servos are driven as wheels")
    bus.write(number, "torque_enable", 0)
    bus.write(number, "moving_speed", 0)
    bus.keep(number, "mode", int(turns))


def relax(bus: ServoBus, joint: Joint) -> None:
    try:
        bus.write(joint.id, "torque_enable", 0)
    except SilentError as error:
        raise RefusedError(f"{joint.name} (ID {joint.id}) does not answer on {bus.path}") from error


def position_of(bus: ServoBus, joint: Joint) -> float:
    """Mean position over a moment, counts. Raises RefusedError when the joint moves meanwhile."""
    positions = []
    for _ in range(READINGS):
        positions.append(bus.reading(joint.id).position)
        time.sleep(0.01)  # spread over time, so that an unsteady hand is noticed
    if (max(positions) - min(positions)) * joint.units.count_rad > TURNED_RAD:
        raise RefusedError(f"{joint.name} moved while it was measured; hold it still")
    return sum(positions) / len(positions)


def calibrate(bus: ServoBus, joint: Joint, at_deg: float, prompt: Callable[[str], None]) -> dict[str, float | int]:
    """Measure a joint's zero and sense of rotation: the operator turns it to a known angle, then towards greater
    angles. Returns the values for its [[joint]] row. Where the servo can, the known angle becomes the middle of its
    range, so that its positions do not jump from the last to the first within the joint's limits. Raises RefusedError
    when it was not turned or did not keep still."""
    count_deg = degrees(joint.units.count_rad)
    relax(bus, joint)
    prompt(f"{joint.name}: turn it to {at_deg:g} degrees by hand, and hold it there")
    there = position_of(bus, joint)
    if bus.family.centring is not None:
        bus.keep(joint.id, *bus.family.centring)
        relax(bus, joint)
        there = position_of(bus, joint)
    prompt(f"{joint.name}: now turn it some way towards greater angles")
    turned = position_of(bus, joint) - there
    if abs(turned) * joint.units.count_rad < TURNED_RAD:
        raise RefusedError(f"{joint.name} was turned by {abs(turned) * count_deg:.1f} degrees only")
    direction = 1 if turned > 0 else -1
    centre = there - direction * at_deg / count_deg
    return {"direction": direction, "centre_count": round(centre, 2)}


def feel_limits(
    bus: ServoBus, joint: Joint, done: Callable[[], bool], show: Callable[[str], None]
) -> tuple[float, float]:
    """Measure the ends between which the operator turns a limp joint until `done`; returns limits in degrees, with a
    margin. Raises RefusedError when the joint was hardly turned."""
    relax(bus, joint)
    low, high = inf, -inf
    while not done():
        try:
            position = bus.reading(joint.id).position
        except SilentError:
            continue
        if low <= high and min(abs(position - low), abs(position - high)) * joint.units.count_rad > pi:
            raise RefusedError(f"{joint.name} passed the end of its servo's range; first calibrate it in its middle")
        if position < low or position > high:
            low, high = min(low, position), max(high, position)
            ends = sorted(degrees(joint.to_angle(count)) for count in (low, high))
            show(f"{joint.name}: {ends[0]:.1f} to {ends[1]:.1f} degrees")
    if not (high - low) * joint.units.count_rad >= 2 * TURNED_RAD:  # also when nothing was read
        raise RefusedError(f"{joint.name} was hardly turned; nothing is changed")
    first, last = sorted(degrees(joint.to_angle(count)) for count in (low, high))
    return round(first + MARGIN_DEG, 1), round(last - MARGIN_DEG, 1)


def write_limits(bus: ServoBus, joint: Joint, limits_deg: tuple[float, float]) -> tuple[int, int]:
    """Write a joint's limits into its servo, which then goes to no goal beyond them; returns them in counts. Raises
    CocoroError when the servo does not confirm."""
    ends = sorted(joint.to_count(radians(limit)) for limit in limits_deg)
    try:
        bus.keep(joint.id, "low_limit", ends[0])
        bus.keep(joint.id, "high_limit", ends[1])
    except (SilentError, RefusedWriteError) as error:
        raise CocoroError(f"{joint.name}: {error}") from error
    return ends[0], ends[1]
