"""Commands on the mesh"""

from __future__ import annotations

import asyncio
import os
import re
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from apps.captures.export.rerun_scene import RerunScene, library, log_capture, no_viewer, opened
from apps.captures.player import Player
from apps.captures.replay import SIMULATOR, Replay, played_keys, refuse_if_alive, services_of
from apps.cli import exits
from apps.cli.capture_files import check_span
from apps.cli.ending import told_to_end
from apps.cli.link import joined
from apps.cli.options import RobotChoice
from apps.cli.output import going_on
from cocoro.bus.base import Bus, Payload
from cocoro.bus.zenoh import ZenohBus
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.clock import FollowedClock
from cocoro.component import load as load_component
from cocoro.errors import ConfigError, RefusedError
from cocoro.messages import Message, Recording
from cocoro.node import Node
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import RECORDING, TOPICS, Topic
from deploy import processes, robot_time
from deploy.rundir import RunDir
from services.capture.writer import describe_disturbance

RECORDER = "capture"
"""The process whose component does it: loaded by name, since the API knows no services."""
LAST_WORDS_S = 1.0
"""How long the recorder's last word takes at most, after it has ended."""


async def record(where: RobotChoice, settings: dict[str, Any], seconds: float | None) -> int:
    """Record until interrupted, or for so long. Raises MeshError when there is no mesh."""
    row = processes.named(RECORDER)
    component = load_component(row)
    try:
        config = msgspec.convert(settings, component.config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"record: {error}") from error
    async with joined(where, frames=True) as link:
        resolved = link.run_dir.resolved()
        description, measured = (Path(file) if (file := resolved.get(name)) else None for name in _DESCRIPTIONS)
        clock = FollowedClock() if resolved.get("clock") == "sim" else robot_time.clock(link.run_dir.path)
        robot = Robot.load(description, measured)
        name = f"record-{os.getpid()}"
        async with Node(name, link.bus, clock, robot, robot_name=link.robot, module=row.module, config=config) as node:
            view = _RecordingDisplay()
            node.on(RECORDING.of(name), view.show)
            with told_to_end() as end, going_on():
                await _run_until(component.run(node, config), end, view.failed, seconds)
                with suppress(TimeoutError):
                    await asyncio.wait_for(view.ended.wait(), LAST_WORDS_S)
    return view.last_words()


_DESCRIPTIONS = ("description", "measured")


async def _run_until(work: Any, end: asyncio.Event, failed: asyncio.Event, seconds: float | None) -> None:
    """Run until it is told to end; the recorder then closes its file."""
    waits = [asyncio.ensure_future(event.wait()) for event in (end, failed)]
    working = asyncio.ensure_future(work)
    await asyncio.wait((working, *waits), timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    for task in (*waits, working):
        task.cancel()
    with suppress(asyncio.CancelledError):
        await working


class _RecordingDisplay:
    """A line that is written over, on a terminal; elsewhere each file's name."""

    def __init__(self) -> None:
        self.failed = asyncio.Event()
        self.ended = asyncio.Event()
        self._newest: Recording | None = None
        self._files: set[str] = set()

    def show(self, recording: Recording) -> None:
        before, self._newest = self._newest, recording
        new = [file for file in recording.disturbed if before is None or file not in before.disturbed]
        if not recording.ended:
            self._files.add(recording.file)
            for file in new:
                print(
                    f"{CLEAR if sys.stdout.isatty() else ''}cocoro: {describe_disturbance(file)}",
                    file=sys.stderr,
                    flush=True,
                )
        if recording.ended:
            self.ended.set()
        elif recording.fault:
            self.failed.set()
        elif sys.stdout.isatty():
            print(f"{CLEAR}{_recording_line(recording)}", end="", flush=True)
        elif recording.file and (before is None or before.file != recording.file):
            print(recording.file, flush=True)

    def last_words(self) -> int:
        newest = self._newest
        if newest is None:
            print("nothing was recorded")
            return exits.FAILED
        others = len(self._files - {newest.file, ""} - {file.file for file in newest.disturbed})
        others += sum(file.became == "moved" and file.now != newest.file for file in newest.disturbed)
        print(f"{CLEAR if sys.stdout.isatty() else ''}{_recording_line(newest, others)}")
        for file in newest.disturbed:
            print(f"cocoro: {describe_disturbance(file)}", file=sys.stderr)
        if newest.fault:
            print(f"cocoro: {newest.fault}", file=sys.stderr)
        return exits.FAILED if newest.fault or newest.removed else exits.DONE


def _recording_line(recording: Recording, others: int = 0) -> str:
    """`others`: how many files there are besides."""
    missing = sum(recording.dropped.values()), sum(recording.lost.values())
    not_recorded = "".join(
        f", {count} {word}" for count, word in zip(missing, ("dropped", "lost"), strict=True) if count
    )
    more = f" and {others} before it" if others > 0 else ""
    where = f"{recording.file}{more}" if recording.file else "no file is left" if others <= 0 else f"{others} files"
    return f"{where}: {recording.messages} messages, {recording.size_bytes / 1e6:.1f} MB{not_recorded}"


SHOW_S = 0.1
JUMP_S = 5.0
FASTER = 1.25
LEFT, RIGHT = ("\x1b[D", "\x1bOD"), ("\x1b[C", "\x1bOC")
KEY = re.compile(r"\x1b[\[O][A-Z]|.", re.DOTALL)
"""A terminal hands over several at once when they come quickly, as of a key that is held down."""
CLEAR = "\r\x1b[K"
HELP = "space pauses, . steps, left and right 5 s, + and - rate, q ends"


async def replay(file: Path, only: list[str], hardware: bool, options: dict[str, Any]) -> int:
    """Raises CaptureError for a file that is none, RefusedError when the robot is there, ConfigError for nothing to
    play."""
    if options["paused"] and not sys.stdin.isatty():
        raise ConfigError("--paused waits for a key, so it needs a terminal")
    with Capture.open(file) as capture:
        if not capture.robot:
            raise CaptureError(f"{file}: it does not say whose it is, so it was not made by `cocoro record`")
        check_span(capture, options["start_s"], options["end_s"])
        keys = played_keys(capture, only, hardware)
        player = Player(capture, keys.__contains__, **options)
        services = services_of(keys) | (set(processes.hardware()) if hardware else set())
        run_dir = RunDir(capture.robot)
        run_dir.make()
        claims = run_dir.claim("replay", services)
        try:
            async with await ZenohBus.open(run_dir.join_as("replay", frames=True)) as bus:
                await refuse_if_alive(bus, capture.robot, services)
                await _play(bus, capture, player, hardware, services)
        finally:
            for claim in claims:
                claim.release()
        for problem in capture.problems:
            print(f"not played: {problem}", file=sys.stderr)
        if capture.ending:
            print(f"note: {file} was {capture.ending}", file=sys.stderr)
        return exits.FAILED if capture.problems else exits.DONE


async def _play(bus: ZenohBus, capture: Capture, player: Player, hardware: bool, services: frozenset[str]) -> None:
    replaying = Replay(bus, capture, player, hardware=hardware)
    end = asyncio.Event()
    intruder: list[str] = []

    def on_alive(key: str, alive: bool) -> None:
        service = key.split("/")[1]
        if alive and service in ({SIMULATOR} if hardware else services | {*processes.hardware(), SIMULATOR}):
            intruder.append(service)
            end.set()

    watch = bus.watch_alive(f"{capture.robot}/*/alive", on_alive)
    work = asyncio.ensure_future(replaying.run())
    with _keyboard(lambda text: _handle_key(text, player, replaying, end)) as has_keys:
        showing = asyncio.ensure_future(_show_replay(player, replaying, has_keys))
        ending = asyncio.ensure_future(end.wait())
        try:
            await asyncio.wait((work, ending), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (work, ending, showing):
                task.cancel()
            with suppress(asyncio.CancelledError):
                await work
            watch.close()
    print(f"{CLEAR if sys.stdout.isatty() else ''}{_replay_line(player, replaying)}")
    if intruder:
        raise RefusedError(f"stopped: {intruder[0]} of {capture.robot} has come up, and its keys are its own")


@contextmanager
def _keyboard(pressed: Callable[[str], None]) -> Iterator[bool]:
    """Each key's text goes to `pressed`, where there is a keyboard; yields whether there is."""
    if not sys.stdin.isatty():
        yield False
        return
    fd, loop = sys.stdin.fileno(), asyncio.get_running_loop()
    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)

    def read() -> None:
        for key in KEY.findall(os.read(fd, 32).decode(errors="replace")) or [""]:
            pressed(key)

    loop.add_reader(fd, read)
    try:
        yield True
    finally:
        loop.remove_reader(fd)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


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
    elif text in ("q", "\x03", "\x04", ""):
        end.set()
    replaying.changed()


async def _show_replay(player: Player, replaying: Replay, has_keys: bool) -> None:
    """How far it is: one line that is written over, where somebody watches."""
    if has_keys:
        print(HELP)
    while sys.stdout.isatty():
        print(f"{CLEAR}{_replay_line(player, replaying)}", end="", flush=True)
        await asyncio.sleep(SHOW_S)


def _replay_line(player: Player, replaying: Replay) -> str:
    position_s = player.position_s(asyncio.get_running_loop().time())
    state = "paused " if player.paused else ""
    again = f", pass {player.passes + 1}" if player.passes else ""
    return f"{state}{position_s:.1f} of {player.length_s:.1f} s, x{player.rate:.2f}, {replaying.sent} messages{again}"


PER_SERVICE = "{service}"
WAITING = 4
"""Messages of a key; a viewer that is behind shows the newest."""


def view_file(file: Path) -> int:
    """Open Rerun on a capture. Raises CaptureError when Rerun is not installed, or cannot be opened."""
    rr = library()
    with Capture.open(file) as capture:
        recording = opened(rr)
        with no_viewer():
            count = log_capture(capture, recording)
            recording.flush()
        print(f"{count} messages are in Rerun")
        return exits.FAILED if capture.problems else exits.DONE


async def view_mesh(where: RobotChoice) -> int:
    """Open Rerun on the mesh, until Ctrl-C. Raises CaptureError when Rerun is not installed, MeshError for no mesh."""
    rr = library()
    async with joined(where, frames=True) as link:
        resolved = link.run_dir.resolved()
        description, measured = (_path(resolved.get(name)) for name in ("description", "measured"))
        recording = opened(rr)
        watch(link.bus, link.robot, RerunScene(recording, Robot.load(description, measured), Catalogue.load()))
        print("Ctrl-C ends it")
        with told_to_end() as end:
            await end.wait()
    return exits.DONE


def watch(bus: Bus, robot: str, scene: RerunScene) -> None:
    """Tell of everything that travels from now on, however old it is: a viewer acts on nothing."""

    def heard(topic: Topic[Any], decoder: msgspec.msgpack.Decoder[Message], _key: str, payload: Payload) -> None:
        with suppress(msgspec.MsgspecError, ValueError, RecursionError):
            scene.log(topic.name, decoder.decode(payload))

    for topic in TOPICS:
        if PER_SERVICE not in topic.name:
            handler = partial(heard, topic, msgspec.msgpack.Decoder(topic.type))
            bus.subscribe(topic.key(robot), topic.qos, handler, depth=WAITING)


def _path(file: Any) -> Path | None:
    return None if file is None else Path(file)
