"""Emulates a Create and a Calliope's servos without physics, until Ctrl-C: `python -m sim.wire DIR`.

For first steps with the tools. It makes in DIR one port for each of the robot's lines (a Calliope's `arm` and `hand`),
the port `create` if it stands on one, and the socket `control` (see `sim.wire.control`).
"""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress
from pathlib import Path

from cocoro.errors import ConfigError
from cocoro.robot import Robot
from sim.wire.control import Control, ControlServer
from sim.wire.create import EmulatedCreate
from sim.wire.emulator import Device, Emulator, SimplePlant
from sim.wire.models import model_of, servo_of, servos_on_lines, wheel_of
from sim.wire.servo import EmulatedServoBus


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.wire", description="Emulated hardware on pseudo-terminals.")
    parser.add_argument("folder", type=Path, help="folder for the ports")
    parser.add_argument("--robot", type=Path, metavar="NAME|FILE", help="lekiwi, or the file of a robot's description")
    parser.add_argument("--description", dest="robot", type=Path, help=argparse.SUPPRESS)  # its former spelling
    parser.add_argument("--measured", type=Path, metavar="FILE", help="values that were measured on this robot")
    options = parser.parse_args()
    folder: Path = options.folder
    try:
        robot = Robot.load(options.robot, options.measured)
        lines = servos_on_lines(robot)
    except ConfigError as error:
        parser.error(str(error))
    create = EmulatedCreate() if robot.base.kind == "differential" else None
    buses = {
        line: EmulatedServoBus(
            [
                *(servo_of(model_of(joint.group, protocol), joint.id, joint.overload_s) for joint in joints),
                *(wheel_of(place, protocol) for place in robot.base.servo_places if place.network == line),
            ]
        )
        for line, (protocol, joints) in lines.items()
    }
    devices: dict[str, Device] = {**({} if create is None else {"create": create}), **buses}
    emulator = Emulator(folder, devices, SimplePlant(create, *buses.values()))
    with ControlServer(folder, Control(emulator)), suppress(KeyboardInterrupt):
        print("\n".join(str(folder / name) for name in emulator.lines), flush=True)
        emulator.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
