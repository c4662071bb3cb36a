"""`cocoro servos scan`, `set-id`, `calibrate` and `limits`: done at the line itself, while the service is down."""

from __future__ import annotations

import json as json_module
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apps.cli import exits
from apps.cli.robot_file import write_values
from apps.cli.table import print_table
from cocoro.component import load
from cocoro.errors import CocoroError, ConfigError, RefusedError
from cocoro.ports import port_path
from cocoro.robot import Joint, Robot
from deploy import profiles
from deploy.processes import named
from deploy.profiles import Profile
from services.servos import tools
from services.servos.bus import ServoBus


@dataclass
class ServoWorkbench:
    """A robot, its ports and the file of its own, as a profile tells."""

    profile: Profile
    robot: Robot
    ports: dict[str, str]
    """By network."""
    file: Path

    @classmethod
    def of(cls, profile_name: str, write: Path | None) -> ServoWorkbench:
        profile = profiles.read(profile_name)
        description = None if profile.description is None else Path(profile.description)
        measured = None if profile.measured is None else Path(profile.measured)
        there = measured if measured is not None and measured.exists() else None
        robot = Robot.load(description, there)
        config = profile.config("servos", load(named("servos")).config)
        ports: dict[str, str] = {
            name: port_path(getattr(config, f"{name}_port"), profile.robot) for name in robot.networks
        }
        return cls(profile, robot, ports, write or measured or Path(f"{profile.robot}-measured.toml"))

    def joint(self, name: str) -> Joint:
        if name not in self.robot.joints:
            raise ConfigError(f"there is no joint {name!r}; there are {', '.join(self.robot.joints)}")
        return self.robot.joints[name]

    @contextmanager
    def line(self, joint: Joint, port: str | None, baud: int | None) -> Iterator[ServoBus]:
        with ServoBus(port or self.ports[joint.network], baud or self.robot.networks[joint.network].baud, 0.05) as line:
            yield line

    def write(self, joint: Joint, values: dict[str, Any]) -> None:
        write_values(self.file, "joint", values, joint.name)
        told = ", ".join(f"{key} = {value}" for key, value in values.items())
        print(f"{joint.name}: {told}; written to {self.file}")
        if self.profile.measured is None:
            print(f'Name it in the profile: measured = "{self.file}"')


def scan(profile: str, ports: list[str], bauds: list[int], last: int, write: Path | None, as_json: bool) -> int:
    """Exit code 1 when a servo of the robot's was not found."""
    shop = ServoWorkbench.of(profile, None)
    known = [port for port in dict.fromkeys(shop.ports.values()) if Path(port).exists()]
    resolved = {str(Path(port).resolve()) for port in known}
    wanted = ports or known + [port for port in tools.candidates() if str(Path(port).resolve()) not in resolved]
    if not wanted:
        raise ConfigError("there is no serial port here: plug the servos' adapters in, or name one with --port")

    def tell(text: str) -> None:
        print(text, file=sys.stderr)

    found = list(tools.scan(wanted, bauds or tools.BAUDS, range(1, last + 1), tell))
    names = {joint.id: joint for joint in shop.robot.joints.values()}
    if as_json:
        print(json_module.dumps([one._asdict() for one in found]))
    else:
        _print_found(found, names)
    missing = [joint for number, joint in names.items() if number not in {one.number for one in found}]
    if missing and not as_json:
        print(f"not found: {', '.join(f'{joint.name} (ID {joint.id})' for joint in missing)}")
    if write is not None:
        _write_ports(shop, found, names, write)
    return exits.FAILED if missing else exits.DONE


def _print_found(found: list[Any], names: dict[int, Joint]) -> None:
    rows = []
    for one in found:
        joint = names[one.number].name if one.number in names else "?"
        errors = ", ".join(one.errors)
        delay = f"{one.return_delay_us} us" if one.return_delay_us else ""
        rows.append(
            (one.port, str(one.baud), str(one.number), joint, one.model, str(one.position), f"{one.voltage_v:.1f} V",
             f"{one.temperature_c} C", delay, errors)
        )  # fmt: skip
    heads = ("port", "baud", "id", "joint", "model", "position", "voltage", "heat", "delay", "errors")
    print_table(heads, rows) if rows else print("no servo answers")


def _write_ports(shop: ServoWorkbench, found: list[Any], names: dict[int, Joint], file: Path) -> None:
    """The port of each network into a profile, and its baud rate into the robot's own file where it is another."""
    for network, row in shop.robot.networks.items():
        places = {(one.port, one.baud) for one in found if one.number in names and names[one.number].network == network}
        if not places:
            continue
        if len(places) > 1:
            raise RefusedError(f"the servos of {network} are on several lines: {sorted(places)}; nothing is written")
        port, baud = places.pop()
        write_values(file, "service.servos", {f"{network}_port": port})
        print(f"{network}_port = {port}; written to {file}")
        if baud != row.baud:
            write_values(shop.file, f"network.{network}", {"baud": baud})
            print(f"{network}: {baud} baud; written to {shop.file}")


def set_id(port: str, baud: int, old: int, new: int) -> int:
    with ServoBus(port, baud, 0.05) as line:
        tools.set_number(line, old, new)
    print(f"the servo on {port} is {new} and answers without delay")
    return exits.DONE


def calibrate(
    profile: str, joints: list[str], at_deg: float, port: str | None, baud: int | None, write: Path | None
) -> int:
    shop = ServoWorkbench.of(profile, write)
    for joint in [shop.joint(name) for name in joints]:
        with shop.line(joint, port, baud) as line:
            shop.write(joint, tools.calibrate(line, joint, at_deg, _ask))
    return exits.DONE


def limits(profile: str, joints: list[str], port: str | None, baud: int | None, write: Path | None) -> int:
    shop = ServoWorkbench.of(profile, write)
    for joint in [shop.joint(name) for name in joints]:
        with shop.line(joint, port, baud) as line:
            print(f"{joint.name} is limp: turn it from end to end, then press Enter")
            ends_deg = tools.feel_limits(line, joint, _entered, lambda text: print(f"\r{text}   ", end="", flush=True))
            print()
            shop.write(joint, {"limits_deg": ends_deg})
            tools.write_limits(line, joint, ends_deg)
    return exits.DONE


def _ask(text: str) -> None:
    try:
        input(f"{text}, then press Enter ")
    except EOFError:
        raise CocoroError("somebody has to be there for this, at a terminal") from None


def _entered() -> bool:
    """Whether a line was entered; does not wait."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True
