"""`cocoro servos`: commands to the running service, and tools at the serial line while the service is down."""

from __future__ import annotations

import asyncio
import select
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.cli import completions, exits
from apps.cli.link import MeshLink, joined
from apps.cli.options import (
    AnyRobotOption,
    JsonOption,
    MeasuredOption,
    ProfileOption,
    RobotChoice,
    RobotOption,
    ThroughOption,
)
from apps.cli.output import complain, print_json, tell
from apps.cli.servo_bench import REPLY_S, BaudOption, PortOption, ServoWorkbench, WriteOption
from apps.cli.servo_import import import_lerobot
from apps.cli.terminal import StatusLine, print_table
from apps.cli.toml_files import write_values
from cocoro.errors import CocoroError, ConfigError, MeshError, RefusedError, choice_of
from cocoro.joints import GROUPS, Group, ServoPlace
from cocoro.messages import ServoReply, ServoRequest
from cocoro.robot import Robot
from cocoro.topics import SERVOS
from services.servos import tools
from services.servos.bus import ServoBus
from services.servos.tools import FoundServo

DONE_WORDS = {"clear": "cleared", "relax": "limp", "hold": "holding"}
NOBODY = "this command waits for a person at a terminal, but standard input has ended"

JointsArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[JOINT]...", autocompletion=completions.joints, help="Names of joints; all joints by default."
    ),
]
JointArguments = Annotated[
    list[str],
    typer.Argument(
        metavar="JOINT...", autocompletion=completions.joints, help="Names of joints, worked on one after the other."
    ),
]
PortsOption = Annotated[
    list[str] | None,
    typer.Option("--port", metavar="DEVICE", help="Serial port, instead of the profile's. Repeatable."),
]

app = typer.Typer()
servos = typer.Typer(
    no_args_is_help=True, help="Find, set up, calibrate, hold and relax the servos; clear their faults."
)
app.add_typer(servos, name="servos")


# --- requests to the running service ----------------------------------------------------------------


@servos.command()
def clear(
    joints: JointsArgument = None, robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """Clear latched faults, such as an overload; the joints then hold where they are."""
    sys.exit(asyncio.run(request(RobotChoice(robot, site), "clear", joints or [], json)))


@servos.command()
def relax(
    joints: JointsArgument = None, robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """Make joints limp, so that they can be turned by hand. The arm sinks: hold it."""
    sys.exit(asyncio.run(request(RobotChoice(robot, site), "relax", joints or [], json)))


@servos.command()
def hold(
    joints: JointsArgument = None, robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """Make joints hold where they are."""
    sys.exit(asyncio.run(request(RobotChoice(robot, site), "hold", joints or [], json)))


async def request(choice: RobotChoice, action: str, joints: list[str], as_json: bool = False) -> int:
    """Sends an action to the groups that have these joints; the exit code is 3 when one could not do it.

    Raises MeshError when a group's service is not running, ConfigError for an unknown joint and for one of no group.
    """
    code, done = exits.DONE, list[dict[str, Any]]()
    async with joined(choice) as link:
        groups = _groups_of(joints, await link.described())
        alive = await link.alive()
        missing = [group for group in groups if group not in alive]
        if missing:
            raise MeshError(link.missing(missing[0]))
        for group, names in groups.items():
            reply = await _request_one(link, group, action, names)
            done.append({"group": group, "done": DONE_WORDS[action], "joints": reply.joints, "problem": reply.text})
            if not as_json:
                print(f"{group}: {DONE_WORDS[action]}: {', '.join(reply.joints) or 'none'}")
            if reply.text:
                complain(f"{group}: {reply.text}")
                code = exits.REFUSED
    if as_json:
        print_json(done)
    return code


async def _request_one(link: MeshLink, group: Group, action: str, joints: list[str]) -> ServoReply:
    question = ServoRequest(action=action, joints=tuple(joints))  # type: ignore[arg-type] # one of three, by the command
    try:
        return await link.call(SERVOS.of(group), question)
    except MeshError as error:
        raise MeshError(f"{group} does not answer `{action}`; only real servos do, not simulated ones") from error


def _groups_of(joints: list[str], robot: Robot) -> dict[Group, list[str]]:
    """Joints by group; no joints stand for all of all groups. Raises ConfigError for an unknown joint, and for one that
    no command addresses."""
    known = robot.joints
    if unknown := [joint for joint in joints if joint not in known]:
        raise ConfigError(f"there is no joint {unknown[0]!r}; {choice_of(unknown[0], known)}")
    if not joints:
        return {group: [] for group in GROUPS}
    found: dict[Group, list[str]] = {}
    for joint in joints:
        if (group := known[joint].group) is None:
            raise ConfigError(f"{joint} is no joint of arm or hand, so no command addresses it")
        found.setdefault(group, []).append(joint)
    return found


# --- tools at the serial line -----------------------------------------------------------------------


@servos.command()
def scan(
    profile: ProfileOption = "robot",
    port: PortsOption = None,
    baud: Annotated[list[int] | None, typer.Option(metavar="RATE", help="Only these baud rates. Repeatable.")] = None,
    last: Annotated[int, typer.Option(min=1, max=253, help="The highest ID to ask for.")] = 20,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="FILE", help="Write the ports that were found into this profile.")
    ] = None,
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
    json: JsonOption = False,
) -> None:
    """Find servos on every serial port, at every baud rate. The robot must be down."""
    bench = ServoWorkbench.of(profile, None, robot, measured)
    sys.exit(scan_ports(bench, port or [], baud or [], last, write, json))


def scan_ports(
    bench: ServoWorkbench, ports: list[str], bauds: list[int], last: int, write: Path | None, as_json: bool
) -> int:
    """Prints the servos that answer; the exit code is 1 when one of the robot's servos does not."""
    known = [port for port in dict.fromkeys(bench.ports.values()) if Path(port).exists()]
    resolved = {str(Path(port).resolve()) for port in known}
    wanted = ports or known + [port for port in tools.candidates() if str(Path(port).resolve()) not in resolved]
    if not wanted:
        raise ConfigError("no serial port found: plug in the servos' adapters, or name a port with --port")

    def report(text: str) -> None:
        print(text, file=sys.stderr)

    found = list(tools.scan(wanted, bauds or tools.BAUDS, range(1, last + 1), report))
    owners = {one: place for one in found if (place := bench.owner(one)) is not None}
    if as_json:
        print_json([one._asdict() for one in found])
    else:
        _print_found(found, owners)
    there = set(owners.values())
    missing = [place for place in bench.places if place not in there]
    if missing and not as_json:
        print(f"not found: {', '.join(f'{place.title} (ID {place.id})' for place in missing)}")
    if write is not None:
        _write_ports(bench, owners, write)
    return exits.FAILED if missing else exits.DONE


def _print_found(found: list[FoundServo], owners: Mapping[FoundServo, ServoPlace]) -> None:
    rows = []
    for one in found:
        joint = owners[one].title if one in owners else "?"
        errors = ", ".join(one.errors)
        delay = f"{one.return_delay_us} us" if one.return_delay_us else ""
        rows.append(
            (one.port, str(one.baud), str(one.number), joint, one.model, str(one.position), f"{one.voltage_v:.1f} V",
             f"{one.temperature_c} C", delay, errors)
        )  # fmt: skip
    heads = ("port", "baud", "id", "joint", "model", "position", "voltage", "heat", "delay", "errors")
    print_table(heads, rows) if rows else print("no servo answers")


def _write_ports(bench: ServoWorkbench, owners: Mapping[FoundServo, ServoPlace], file: Path) -> None:
    """Writes each line's port into a profile, and what differs of baud rate and protocol into the measured file."""
    for line, row in bench.robot.networks.items():
        places = {(one.port, one.baud, one.protocol) for one, place in owners.items() if place.network == line}
        if not places:
            continue
        if len(places) > 1:
            raise RefusedError(
                f"the servos of {line} are on several lines ({sorted(places)}), so no port was written; connect"
                " them to one line, or write the profile by hand"
            )
        port, baud, protocol = places.pop()
        print(f"{line}: {port}, {baud} baud", flush=True)
        write_values(file, "service.servos.ports", {line: port})
        print(f"the port is written to {file}")
        if baud != row.baud:
            write_values(bench.file, f"network.{line}", {"baud": baud})
            print(f"the baud rate is written to {bench.file}")
        if protocol != row.protocol:
            write_values(bench.file, f"network.{line}", {"protocol": protocol})
            print(f"its protocol, {protocol}, is written to {bench.file}")


@servos.command("set-id")
def set_id(
    old: Annotated[int, typer.Argument(min=0, max=253, help="The servo's ID now.")],
    new: Annotated[int, typer.Argument(min=0, max=253, help="Its new ID.")],
    port: Annotated[str, typer.Option(metavar="DEVICE", help="The serial port that it is connected to.")],
    baud: Annotated[int, typer.Option(metavar="RATE", help="The servo's baud rate.")] = 1_000_000,
    json: JsonOption = False,
) -> None:
    """Give a servo another ID, and set its return delay to 0. Best with no other servo on the line."""
    with ServoBus(port, baud, REPLY_S, tries=tools.TRIES) as line:
        tools.set_number(line, old, new)
    data = {"port": port, "id": new, "return_delay_us": 0}
    tell(json, data, f"the servo on {port} has ID {new} and return delay 0")


@servos.command("set-wheel")
def set_wheel(
    number: Annotated[int, typer.Argument(metavar="ID", min=0, max=253, help="The servo's ID.")],
    port: Annotated[str, typer.Option(metavar="DEVICE", help="The serial port that it is connected to.")],
    baud: Annotated[int, typer.Option(metavar="RATE", help="The servo's baud rate.")] = 1_000_000,
    joint: Annotated[bool, typer.Option("--joint", help="Make it a servo for a joint again.")] = False,
    json: JsonOption = False,
) -> None:
    """Set a Feetech servo up as a wheel, which turns endlessly. The robot must be down."""
    with ServoBus(port, baud, REPLY_S, tries=tools.TRIES) as line:
        tools.set_wheel(line, number, turns=not joint)
    what = "goes to goals" if joint else "turns endlessly"
    tell(
        json, {"port": port, "id": number, "wheel": not joint}, f"the servo {number} on {port} {what}, and is limp now"
    )


@servos.command()
def calibrate(
    joints: JointArguments,
    at: Annotated[float, typer.Option(metavar="DEG", help="The angle to which you will turn the joint.")] = 0.0,
    profile: ProfileOption = "robot",
    port: PortOption = None,
    baud: BaudOption = None,
    write: WriteOption = None,
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
) -> None:
    """Measure a joint's zero and direction while you turn it by hand. The robot must be down."""
    bench = ServoWorkbench.of(profile, write, robot, measured)
    for joint in [bench.joint(name) for name in joints]:
        with bench.line(joint, port, baud) as line:
            bench.write(joint, tools.calibrate(line, joint, at, _wait_for_enter))


@servos.command()
def limits(
    joints: JointArguments,
    profile: ProfileOption = "robot",
    port: PortOption = None,
    baud: BaudOption = None,
    write: WriteOption = None,
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
) -> None:
    """Measure a joint's limits while you turn it by hand from end to end. The robot must be down."""
    bench = ServoWorkbench.of(profile, write, robot, measured)
    for joint in [bench.joint(name) for name in joints]:
        with bench.line(joint, port, baud) as line:
            print(f"{joint.name} is limp: turn it from end to end, then press Enter")
            with StatusLine() as status:
                ends_deg = tools.feel_limits(line, joint, _was_entered, status.show)
            bench.write(joint, {"limits_deg": ends_deg})
            tools.write_limits(line, joint, ends_deg)


servos.command("import")(import_lerobot)


def _wait_for_enter(text: str) -> None:
    try:
        input(f"{text}, then press Enter ")
    except EOFError:
        raise CocoroError(NOBODY) from None


def _was_entered() -> bool:
    """Whether a line was entered since the last call; does not wait."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return False
    if not sys.stdin.readline():
        raise CocoroError(NOBODY)
    return True
