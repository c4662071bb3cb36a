"""The checks of `cocoro doctor` for the servos, while their service is down."""

from __future__ import annotations

from cocoro.checks import Check, bad, note, ok
from cocoro.errors import ConfigError
from cocoro.joints import Joint
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
            joints = [robot.joints[joint] for joint in robot.network_joints(name)]
            path, family = port_path(port, robot_name), FAMILIES[row.protocol]
            checks += _servos(name, path, row.baud, family, joints, config.reply_s)
    return checks


def _servos(name: str, path: str, baud: int, family: ServoFamily, joints: list[Joint], reply_s: float) -> list[Check]:
    try:
        with ServoBus(path, baud, max(reply_s, tools.SCAN_S), tries=tools.TRIES) as bus:
            return [_servo(bus, baud, family, joint) for joint in joints]
    except PortError as error:
        return [note(f"{name} servos", f"{error}: does their service run? See `cocoro status`")]


def _servo(bus: ServoBus, baud: int, family: ServoFamily, joint: Joint) -> Check:
    what = f"servo {joint.id}, {joint.name}"
    bus.family = family
    try:
        if not tools.recognise(bus, joint.id):
            raise SilentError(joint.id)
        if bus.family != family:
            kind, says = bus.family.protocol, family.protocol
            return bad(what, f'it speaks {kind}, but the robot description says protocol = "{says}" of its network')
        found = tools.examine(bus, baud, joint.id)
    except SilentError:
        return bad(what, f"does not answer at {baud} baud: power, plugs, ID; `cocoro servos scan` finds it")
    text = f"{found.model}, {found.voltage_v:.1f} V, {found.temperature_c} C"
    wrong = []
    if found.errors:
        wrong.append(f"reports {', '.join(found.errors)}: start the robot and `cocoro servos clear`")
    if found.return_delay_us:
        wrong.append(
            f"answers after {found.return_delay_us} us: set that to 0 by `cocoro servos set-id {joint.id} {joint.id}`"
        )
    if found.is_wheel and joint.group is not None:
        wrong.append("is set up as a wheel: give it limits, or its mode 0, with its maker's program")
    if not family.volts[0] <= found.voltage_v <= family.volts[1]:
        wrong.append("bad voltage: check the supply")
    if found.temperature_c >= HOT_C:
        wrong.append("hot: let it cool")
    return bad(what, f"{text}; {'; '.join(wrong)}") if wrong else ok(what, text)
