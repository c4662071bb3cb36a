"""`cocoro replay`: sends a capture into the mesh again, controlled from the keyboard."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from apps.captures.info import left_out_notes
from apps.captures.replay import SIMULATOR, Replay, heard_as, played_keys, refuse_if_alive, services_of
from apps.cli import exits
from apps.cli.capture import check_span
from apps.cli.keyboard import LEFT, QUIT, RIGHT, keyboard
from apps.cli.options import CaptureArgument, FromOption, OnlyOption, ToOption
from apps.cli.terminal import StatusLine
from cocoro.bus.zenoh import ZenohBus
from cocoro.capture.conventions import CaptureError
from cocoro.capture.player import Player
from cocoro.capture.reader import Capture
from cocoro.errors import ConfigError, RefusedError
from cocoro.keys import alive_key, service_of
from deploy import processes, profiles
from deploy.rundir import RunDir, robots
from deploy.survey import REPLAY

SHOW_S = 0.1
JUMP_S = 5.0
FASTER = 1.25
HELP = "space pauses, . steps, left and right 5 s, + and - rate, q ends"


app = typer.Typer()


@app.command()
def replay(
    file: CaptureArgument,
    rate: Annotated[float, typer.Option(min=0.01, max=100.0, help="Speed; 2 is twice as fast.")] = 1.0,
    start: FromOption = None,
    end: ToOption = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    only: OnlyOption = None,
    paused: Annotated[bool, typer.Option("--paused", help="Start paused; needs a terminal.")] = False,
    hardware: Annotated[
        bool, typer.Option("--hardware", help="Publish only what the robot's hardware published: replace the robot.")
    ] = False,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            metavar="NAME",
            help="Publish under this robot's name. Default: the recorded name; with --hardware the robot that waits.",
        ),
    ] = None,
) -> None:
    """Send a capture into the mesh again. With --hardware, `cocoro up replay` in another terminal works on it.

    Keys: space pauses, . goes to the next picture, left and right 5 s, + and - change the rate, q ends.
    """
    options = {"start_s": 0.0 if start is None else start, "end_s": end, "rate": rate, "loop": loop, "paused": paused}
    sys.exit(asyncio.run(replay_file(file, only or [], hardware, options, robot)))


async def replay_file(
    file: Path, only: list[str], hardware: bool, options: dict[str, Any], robot: str | None = None
) -> int:
    """Plays a capture to its end, or until interrupted, and returns the exit code. `options` go to the Player; `robot`
    is the name to publish under, see `_name`.

    Raises CaptureError for a file that is no capture of a robot, RefusedError when a service that it would play is
    alive, ConfigError when there is nothing to play.
    """
    if options["paused"] and not sys.stdin.isatty():
        raise ConfigError("--paused waits for a key, so it needs a terminal")
    with Capture.open(file) as capture:
        if not capture.robot:
            raise CaptureError(
                f"{file}: it names no robot, so it cannot be replayed; `cocoro record` makes captures that can"
            )
        check_span(capture, options["start_s"], options["end_s"])
        keys = played_keys(capture, only, hardware)
        player = Player(capture, keys.__contains__, **options)
        services = services_of(keys) | (set(processes.hardware()) if hardware else set())
        name = _named(robot) if robot is not None else _name(capture.robot, hardware)
        run_dir = RunDir(name)
        run_dir.make()
        for note in left_out_notes(capture):
            print(f"note: {note}", file=sys.stderr)
        claims = run_dir.claim(REPLAY, services)
        try:
            async with await ZenohBus.open(run_dir.join_as("replay", frames=True)) as bus:
                await refuse_if_alive(bus, name, services)
                await _play(bus, capture, player, hardware, services, name)
        finally:
            for claim in claims:
                claim.release()
        for problem in capture.problems:
            print(f"not played: {problem}", file=sys.stderr)
        if capture.ending:
            print(f"note: {file} was {capture.ending}", file=sys.stderr)
        return exits.FAILED if capture.problems else exits.DONE


def _named(robot: str) -> str:
    """Raises ConfigError for what can be no robot's name."""
    try:
        return msgspec.convert(robot, profiles.Name)
    except msgspec.ValidationError as error:
        raise ConfigError(f"--robot {robot}: {profiles.A_NAME}") from error


def _name(recorded: str, hardware: bool) -> str:
    """The name to publish a capture of the robot `recorded` under, when none is asked for. Says on standard error when
    it differs, or when nothing of this machine listens. Raises ConfigError when several robots could be meant."""
    if not hardware:
        return recorded
    up = {it.robot: set(it.claims()) for it in robots() if it.supervisor() is not None or it.claims()}
    name = heard_as(recorded, up)
    if name != recorded:
        print(f"note: published as {name}, which waits for hardware; the capture is of {recorded}", file=sys.stderr)
    elif recorded not in up:
        start = f"`cocoro up replay --set robot={recorded} --detach`"
        print(f"note: {recorded} is not up on this machine; {start} starts what listens", file=sys.stderr)
    return name


async def _play(
    bus: ZenohBus, capture: Capture, player: Player, hardware: bool, services: frozenset[str], name: str
) -> None:
    replaying = Replay(bus, capture, player, hardware=hardware, robot=name)
    end = asyncio.Event()
    intruder: list[str] = []

    def on_alive(key: str, alive: bool) -> None:
        service = service_of(key)
        if alive and service in ({SIMULATOR} if hardware else services | {*processes.hardware(), SIMULATOR}):
            intruder.append(service)
            end.set()

    watch = bus.watch_alive(alive_key(name), on_alive)
    work = asyncio.ensure_future(replaying.run())
    with (
        keyboard(lambda text: _handle_key(text, player, replaying, end)) as has_keys,
        StatusLine() as line,
    ):
        if has_keys:
            print(HELP)
        showing = asyncio.ensure_future(_show(line, player, replaying))
        ending = asyncio.ensure_future(end.wait())
        try:
            await asyncio.wait((work, ending), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (work, ending, showing):
                task.cancel()
            with suppress(asyncio.CancelledError):
                await work
            watch.close()
    print(_position(player, replaying))
    if intruder:
        raise RefusedError(
            f"stopped: {intruder[0]} of {name} has started and publishes the same keys; `cocoro down` ends it"
        )


def _handle_key(text: str, player: Player, replaying: Replay, end: asyncio.Event) -> None:
    now_s = asyncio.get_running_loop().time()
    if text == " ":
        player.toggle(now_s)
    elif text == ".":
        player.step(now_s)
    elif text in (*LEFT, *RIGHT):
        player.seek(now_s, player.position_s(now_s) + (JUMP_S if text in RIGHT else -JUMP_S))
    elif text in ("+", "="):
        player.change_rate(now_s, player.rate * FASTER)
    elif text == "-":
        player.change_rate(now_s, player.rate / FASTER)
    elif text in QUIT:
        end.set()
    replaying.changed()


async def _show(line: StatusLine, player: Player, replaying: Replay) -> None:
    """Keeps the position on the status line."""
    while line.shown:
        line.show(_position(player, replaying))
        await asyncio.sleep(SHOW_S)


def _position(player: Player, replaying: Replay) -> str:
    position_s = player.position_s(asyncio.get_running_loop().time())
    state = "paused " if player.paused else ""
    again = f", pass {player.passes + 1}" if player.passes else ""
    return f"{state}{position_s:.1f} of {player.length_s:.1f} s, x{player.rate:.2f}, {replaying.sent} messages{again}"
