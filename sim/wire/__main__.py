"""Emulates a Create and a Calliope's servos without physics, until Ctrl-C: `python -m sim.wire DIR`.

For first steps with the tools. It makes in DIR the port `create` and one for each of the robot's lines (`arm`
and `hand`), and the socket `control` (see
`sim.wire.control`).
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
from sim.wire.emulator import Emulator, SimplePlant
from sim.wire.models import model_of, servo_of, servos_on_lines
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
        lines = servos_on_lines(Robot.load(options.robot, options.measured))
    except ConfigError as error:
        parser.error(str(error))
    create = EmulatedCreate()
    buses = {
        line: EmulatedServoBus(
            servo_of(model_of(joint.group, protocol), joint.id, joint.overload_s) for joint in joints
        )
        for line, (protocol, joints) in lines.items()
    }
    emulator = Emulator(folder, {"create": create, **buses}, SimplePlant(create, *buses.values()))
    with ControlServer(folder, Control(emulator)), suppress(KeyboardInterrupt):
        print("\n".join(str(folder / name) for name in emulator.lines), flush=True)
        emulator.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
