"""What the tools at the serial line of `cocoro servos` share: a robot with its ports and its own file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.cli.toml_files import write_values
from cocoro.component import load
from cocoro.errors import ConfigError, choice_of
from cocoro.joints import Joint, ServoPlace
from cocoro.ports import port_path
from cocoro.robot import Robot
from deploy.processes import named
from deploy.profiles import Profile
from deploy.which_robot import profile_of
from services.servos import tools
from services.servos.bus import ServoBus
from services.servos.families import FAMILIES
from services.servos.tools import FoundServo

REPLY_S = 0.05
"""Longest wait for one servo's reply on the serial line."""

PortOption = Annotated[
    str | None, typer.Option("--port", metavar="DEVICE", help="Serial port, instead of the profile's.")
]
BaudOption = Annotated[
    int | None, typer.Option("--baud", metavar="RATE", help="Baud rate, instead of the robot description's.")
]
WriteOption = Annotated[
    Path | None,
    typer.Option("--write", metavar="FILE", help="Write the result into this file, not the robot's measured file."),
]


@dataclass
class ServoWorkbench:
    """A robot with the serial ports and the measured file that a profile names."""

    profile: Profile
    robot: Robot
    ports: dict[str, str]
    """Serial port by line."""
    file: Path

    @classmethod
    def of(
        cls, profile_name: str, write: Path | None, which: str | None = None, measured: Path | None = None
    ) -> ServoWorkbench:
        """`which` is a robot as `--robot` has it, by default the profile's. Raises ConfigError for a profile or a robot
        description that cannot be read."""
        profile = profile_of(profile_name, which, measured)
        description, measured = profile.robot_files
        existing = measured if measured is not None and measured.exists() else None
        robot = Robot.load(description, existing)
        config = profile.config("servos", load(named("servos")).config)
        ports = {line: port_path(config.port_of(line), profile.robot) for line in robot.networks}
        return cls(profile, robot, ports, write or measured or Path(f"{profile.robot}-measured.toml"))

    def joint(self, name: str) -> Joint:
        if name not in self.robot.joints:
            raise ConfigError(f"there is no joint {name!r}; {choice_of(name, self.robot.joints)}")
        return self.robot.joints[name]

    @property
    def places(self) -> list[ServoPlace]:
        """The robot's servos: those of joints, and those of wheels."""
        joints = [ServoPlace("joint", row.name, row.network, row.id) for row in self.robot.joints.values()]
        return [*joints, *self.robot.base.servo_places]

    def owner(self, found: FoundServo) -> ServoPlace | None:
        """What has the servo that was found: the only one with its ID, or of several the one whose line has its
        port."""
        alike = [place for place in self.places if place.id == found.number]
        if len(alike) > 1:
            there = Path(found.port).resolve()
            alike = [place for place in alike if Path(self.ports[place.network]).resolve() == there]
        return alike[0] if len(alike) == 1 else None

    @contextmanager
    def line(self, joint: Joint, port: str | None, baud: int | None) -> Iterator[ServoBus]:
        """Opens the serial line that the joint's servo is on."""
        row = self.robot.networks[joint.network]
        where, family = port or self.ports[joint.network], FAMILIES[row.protocol]
        with ServoBus(where, baud or row.baud, REPLY_S, family, tools.TRIES) as line:
            yield line

    def write(self, joint: Joint, values: dict[str, Any]) -> None:
        """Prints the values before they are written: a file that cannot be written must not cost a calibration."""
        text = ", ".join(f"{key} = {value}" for key, value in values.items())
        print(f"{joint.name}: {text}", flush=True)
        write_values(self.file, "joint", values, joint.name)
        print(f"written to {self.file}")
        if self.profile.measured is None:
            print(f'Name the file in the profile: measured = "{self.file}"')
