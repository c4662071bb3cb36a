"""`cocoro drive`: an operator drives with the keys of the terminal."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from typing import Annotated

import typer

from apps.cli import exits
from apps.cli.interrupt import HANDS_OFF, on_reader_gone, on_signals
from apps.cli.keyboard import DOWN, LEFT, QUIT, RIGHT, UP, keyboard
from apps.cli.link import MeshLink, joined
from apps.cli.options import InsteadOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import complain, going_on
from apps.cli.terminal import StatusLine
from apps.client.task_run import ASK_AGAIN_S, UNSETTLED_S
from cocoro.driving import Driving, begin
from cocoro.errors import CocoroError, ConfigError
from cocoro.keys import asker_key
from cocoro.messages import CancelRequest, Motion, ReportRequest, TaskReply, TaskState
from cocoro.topics import CANCEL, PLAN, REPORT

SHOW_S = 0.1
FASTER = 1.25
LEAST_MPS, MOST_MPS = 0.02, 1.0
TURNS_PER_M = 4.0
"""Turn rate by speed, rad/m."""
HEAD_RADPS = 0.8
HAND_MPS, ROUND_RADPS, ROLL_RADPS = 0.10, 0.3, 0.8
END_S = 5.0
"""Wait for the end of the task after the command's own."""
HELP = """\
hold a key to move, let go to stand (it moves for 0.2 s, and on from when the keyboard repeats the key):
  w s  arrows  ahead, back        a d  turn left, right      A D  ahead in an arc
  , .  left, right (a base whose wheels roll aside)
  i k j l      head up, down, left, right
  t g r f z x  hand out, in, up, down, left, right           v b  roll the wrist
  o c          claws open, close  + -  faster, slower        space  stand at once      q  end
"""

app = typer.Typer()


@app.command()
def drive(
    speed: Annotated[
        float,
        typer.Option(
            min=LEAST_MPS,
            max=MOST_MPS,
            metavar="M/S",
            help="Speed of the base at the begin; the robot has limits of its own.",
        ),
    ] = 0.2,
    instead: InsteadOption = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
) -> None:
    """Drive by hand with the keys of this terminal: base, head, arm and claws.

    A key moves the robot for 0.2 s, and for as long as the keyboard repeats it. Keyboards wait before the first
    repetition, 0.25 to 0.7 s by their settings, so the robot pauses after its first 0.2 s. It keeps off what it
    knows of.
    """
    if not sys.stdin.isatty():
        raise ConfigError("`cocoro drive` reads single keys: run it in a terminal")
    sys.exit(asyncio.run(_drive(RobotChoice(robot, site), speed, instead)))


class Keys:
    """What the keys mean, at a speed, m/s, that they change."""

    def __init__(self, speed_mps: float) -> None:
        self.speed_mps = speed_mps

    def motion(self, key: str) -> Motion | None:
        """The motion that a key asks for; None for a key that means nothing."""
        ahead, turn = self.speed_mps, self.speed_mps * TURNS_PER_M
        if key in ("w", *UP):
            return Motion(speed_mps=ahead)
        if key in ("s", *DOWN):
            return Motion(speed_mps=-ahead)
        if key in ("a", *LEFT):
            return Motion(turn_radps=turn)
        if key in ("d", *RIGHT):
            return Motion(turn_radps=-turn)
        if key in "AD":
            return Motion(speed_mps=ahead, turn_radps=turn / 2 if key == "A" else -turn / 2)
        if key in (",", "."):
            return Motion(aside_mps=ahead if key == "," else -ahead)
        return _OTHERS.get(key)

    def change_speed(self, key: str) -> None:
        """Take a key for faster or slower."""
        if key in ("+", "="):
            self.speed_mps = min(self.speed_mps * FASTER, MOST_MPS)
        elif key == "-":
            self.speed_mps = max(self.speed_mps / FASTER, LEAST_MPS)


_OTHERS = {
    " ": Motion(),
    "i": Motion(tilt_radps=HEAD_RADPS),
    "k": Motion(tilt_radps=-HEAD_RADPS),
    "j": Motion(pan_radps=HEAD_RADPS),
    "l": Motion(pan_radps=-HEAD_RADPS),
    "t": Motion(out_mps=HAND_MPS),
    "g": Motion(out_mps=-HAND_MPS),
    "r": Motion(up_mps=HAND_MPS),
    "f": Motion(up_mps=-HAND_MPS),
    "z": Motion(round_radps=ROUND_RADPS),
    "x": Motion(round_radps=-ROUND_RADPS),
    "v": Motion(roll_radps=ROLL_RADPS),
    "b": Motion(roll_radps=-ROLL_RADPS),
    "o": Motion(grip="open"),
    "c": Motion(grip="close"),
}


async def _drive(choice: RobotChoice, speed_mps: float, instead: bool) -> int:
    async with joined(choice) as link:
        asker = f"operator-{link.bus.new_incarnation():x}"
        token = link.bus.declare_alive(asker_key(link.robot, asker))
        try:
            reply = await _begin(link, asker, instead)
            if not reply.accepted:
                complain(f"refused: {reply.text}")
                return exits.REFUSED
            return await _at_the_keys(link, reply.task_id, Keys(speed_mps))
        finally:
            token.close()


async def _begin(link: MeshLink, asker: str, instead: bool) -> TaskReply:
    """Ask for the task, for a short time repeatedly while the robot has only just started."""
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    while True:
        reply = await begin(link, asker=asker, instead=instead)
        if reply.accepted or loop.time() - begun_s >= UNSETTLED_S.get(reply.refusal or "", 0.0):
            return reply
        await asyncio.sleep(ASK_AGAIN_S)


async def _at_the_keys(link: MeshLink, task_id: str, keys: Keys) -> int:
    """Drive until `q`, a signal, or the end of the task; returns the exit code."""
    plan = link.latest(PLAN)
    end = asyncio.Event()
    async with Driving(link, task_id) as driving:

        def pressed(key: str) -> None:
            if key in QUIT:
                end.set()
                return
            keys.change_speed(key)
            motion = keys.motion(key)
            if motion is not None:
                driving.motion = motion

        print(HELP, end="", flush=True)
        with (
            on_signals(HANDS_OFF, lambda _number: end.set(), hurried=True),
            on_reader_gone(end.set),
            going_on(),
            keyboard(pressed),
            StatusLine() as line,
        ):
            ended, over = (asyncio.ensure_future(event.wait()) for event in (end, driving.over))
            try:
                while not (ended.done() or over.done()):
                    why = driving.trouble or driving.reply.text or (plan.value.why if plan.value is not None else "")
                    line.show(f"{keys.speed_mps:.2f} m/s  {why}")
                    await asyncio.wait((ended, over), timeout=SHOW_S, return_when=asyncio.FIRST_COMPLETED)
            finally:
                ended.cancel()
                over.cancel()
    return await _end(link, task_id, left=end.is_set())


async def _end(link: MeshLink, task_id: str, *, left: bool) -> int:
    """End the task, and say how it ended; returns the exit code. `left`: by the operator himself."""
    state = TaskState()
    loop = asyncio.get_running_loop()
    until_s = loop.time() + END_S
    with suppress(CocoroError):
        if left:
            await link.call(CANCEL, CancelRequest(task_id=task_id))
        while loop.time() < until_s:
            state = await link.call(REPORT, ReportRequest(task_id=task_id))
            if state.outcome is not None or not state.task_id:
                break
            await asyncio.sleep(ASK_AGAIN_S)
    if state.outcome is None:
        complain("it is not known how the task ended: see `cocoro status`")
        return exits.FAILED
    if left and state.reason == "by the operator":
        print(f"drive ended after {state.elapsed_s:.1f} s; the robot stands")
        return exits.DONE
    reason = f": {state.reason}" if state.reason else ""
    print(f"{state.outcome}: drive after {state.elapsed_s:.1f} s{reason}")
    return {"done": exits.DONE, "failed": exits.FAILED}.get(state.outcome, exits.REFUSED)
