"""The checks of `cocoro doctor` for the servos, while their service is down."""

from __future__ import annotations

from typing import NamedTuple

from cocoro.checks import Check, bad, note, ok
from cocoro.errors import ConfigError
from cocoro.ports import check_port, port_path
from cocoro.robot import Robot
from services.servos import tools
from services.servos.bus import PortError, ServoBus, SilentError
from services.servos.families import FAMILIES
from services.servos.family import ServoFamily
from services.servos.service import ServosConfig
from services.servos.watch import HOT_C

__all__ = ["check"]


def check(config: ServosConfig, robot: Robot, robot_name: str) -> list[Check]:
    checks: list[Check] = []
    try:
        config.check(robot)
    except ConfigError as error:
        checks.append(bad("servo settings", str(error)))
    for name, row in robot.networks.items():
        port = config.port_of(name)
        checked = check_port(name, port, robot_name, quick=True)
        checks += checked
        if checked[0].state == "ok":
            path, family = port_path(port, robot_name), FAMILIES[row.protocol]
            checks += _servos(name, path, row.baud, family, _on_line(robot, name), config.reply_s)
    return checks


class _Wanted(NamedTuple):
    """A servo that should be on the line."""

    number: int
    name: str
    turns: bool | None
    """Whether it is to be set up as a wheel; None when that is of no matter."""


def _on_line(robot: Robot, line: str) -> list[_Wanted]:
    joints = [robot.joints[joint] for joint in robot.network_joints(line)]
    wheels = [place for place in robot.base.servo_places if place.network == line]
    return [
        *(_Wanted(joint.id, joint.name, None if joint.group is None else False) for joint in joints),
        *(_Wanted(place.id, f"wheel {place.name}", True) for place in wheels),
    ]


def _servos(name: str, path: str, baud: int, family: ServoFamily, servos: list[_Wanted], reply_s: float) -> list[Check]:
    try:
        with ServoBus(path, baud, max(reply_s, tools.SCAN_S), tries=tools.TRIES) as bus:
            return [_servo(bus, baud, family, one) for one in servos]
    except PortError as error:
        return [note(f"{name} servos", f"{error}: does their service run? See `cocoro status`")]


def _servo(bus: ServoBus, baud: int, family: ServoFamily, wanted: _Wanted) -> Check:
    number, what = wanted.number, f"servo {wanted.number}, {wanted.name}"
    bus.family = family
    try:
        if not tools.recognise(bus, number):
            raise SilentError(number)
        if bus.family != family:
            kind, says = bus.family.protocol, family.protocol
            return bad(what, f'it speaks {kind}, but the robot description says protocol = "{says}" of its network')
        found = tools.examine(bus, baud, number)
    except SilentError:
        return bad(what, f"does not answer at {baud} baud: power, plugs, ID; `cocoro servos scan` finds it")
    text = f"{found.model}, {found.voltage_v:.1f} V, {found.temperature_c} C"
    wrong = []
    if found.errors:
        clear = "cocoro base recover" if wanted.turns else "cocoro servos clear"
        wrong.append(f"reports {', '.join(found.errors)}: start the robot and `{clear}`")
    if found.return_delay_us:
        wrong.append(
            f"answers after {found.return_delay_us} us: set that to 0 by `cocoro servos set-id {number} {number}`"
        )
    if found.is_wheel and wanted.turns is False:
        wrong.append("is set up as a wheel: give it limits, or its mode 0, with its maker's program")
    if wanted.turns and not found.is_wheel:
        wrong.append(f"is not set up as a wheel: `cocoro servos set-wheel {number}`")
    if not family.volts[0] <= found.voltage_v <= family.volts[1]:
        wrong.append("bad voltage: check the supply")
    if found.temperature_c >= HOT_C:
        wrong.append("hot: let it cool")
    return bad(what, f"{text}; {'; '.join(wrong)}") if wrong else ok(what, text)
