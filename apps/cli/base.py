"""`cocoro base`: the state of the base, and how it returns to the mode in which it obeys."""

from __future__ import annotations

import asyncio
import sys
from math import degrees

import msgspec
import typer

from apps.cli import exits
from apps.cli.link import joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import complain, print_json, tell
from cocoro.errors import MeshError
from cocoro.messages import BaseState, RecoverRequest
from cocoro.topics import BASE_STATE, HEALTH, RECOVER
from deploy.survey import within

WAIT_S = 2.5
"""Longest wait for the base's state and health."""


app = typer.Typer()
base = typer.Typer(invoke_without_command=True)
app.add_typer(base, name="base")


@base.callback()
def show_base(
    context: typer.Context, robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """Show the base: mode, battery, bumpers, odometry; `recover` puts it back into its mode."""
    if context.invoked_subcommand is None:
        sys.exit(asyncio.run(show(RobotChoice(robot, site), json)))


@base.command()
def recover(robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False) -> None:
    """Put a Create that left its mode back into it; clear the faults of wheels that servos turn."""
    sys.exit(asyncio.run(recover_base(RobotChoice(robot, site), json)))


async def show(choice: RobotChoice, as_json: bool) -> int:
    """Prints the base's state and faults; the exit code is 1 when it has faults or is silent."""
    async with joined(choice) as link:
        if "base" not in await link.alive():
            raise MeshError(link.missing("base"))
        state, health = link.latest(BASE_STATE), link.latest(HEALTH.of("base"))
        changed = asyncio.Event()
        link.inbox(BASE_STATE).add(lambda _key, _message: changed.set())
        link.inbox(HEALTH.of("base")).add(lambda _key, _message: changed.set())
        await within(WAIT_S, lambda: state.value is not None and health.value is not None, changed)
        newest, faults = state.value, None if health.value is None else health.value.faults
    if as_json:
        print_json({"state": msgspec.to_builtins(newest), "faults": list(faults or ())})
    else:
        _print(newest, faults or ())
    return exits.DONE if newest is not None and faults == () else exits.FAILED


def _print(state: BaseState | None, faults: tuple[str, ...]) -> None:
    if state is None:
        print(f"base       publishes nothing (waited {WAIT_S:g} s)")
    else:
        pressed = [
            name
            for name, on in (
                ("bump left", state.bump_left),
                ("bump right", state.bump_right),
                ("wheel drop", state.wheel_drop),
                ("cliff", state.cliff),
                ("overcurrent", state.overcurrent),
            )
            if on
        ]
        x_m, y_m = state.odometry_m
        charging = ", charging" if state.charging else ""
        print(f"mode       {state.mode}")
        print(f"wheels     {state.speed_mps:.2f} m/s, {degrees(state.turn_rate_radps):.0f} deg/s")
        print(f"stopped    {f'by {state.stopped_by}' if state.stopped_by else 'no'}")
        print(f"battery    {100 * state.battery_fraction:.0f}%, {state.battery_v:.1f} V{charging}")
        print(f"sensors    {', '.join(pressed) or 'nothing'}")
        print(f"odometry   {x_m:.2f} m, {y_m:.2f} m, {degrees(state.odometry_yaw_rad):.0f} deg since its start")
    for fault in faults:
        print(f"fault      {fault}")


async def recover_base(choice: RobotChoice, as_json: bool = False) -> int:
    """Asks the base to recover; the exit code is 3 when it cannot."""
    async with joined(choice) as link:
        reply = await link.call(RECOVER, RecoverRequest())
        robot = link.robot
    if not reply.recovered:
        complain(f"{robot}: the base does not recover: {reply.text}")
        return exits.REFUSED
    tell(as_json, {"robot": robot, "recovered": True}, f"{robot}: the base obeys")
    return exits.DONE
