"""`cocoro base`: what the base is like, and its way back into the mode in which it obeys."""

from __future__ import annotations

import asyncio
import json
from math import degrees

import msgspec

from apps.cli import exits
from apps.cli.link import joined, within
from apps.cli.options import RobotChoice
from cocoro.errors import MeshError
from cocoro.messages import BaseState, Health, RecoverRequest
from cocoro.topics import BASE_STATE, HEALTH, RECOVER

HEARD_S = 2.5


async def show(where: RobotChoice, as_json: bool) -> int:
    """Exit code 1 when it is not well."""
    async with joined(where) as link:
        if "base" not in await link.alive():
            raise MeshError(f"{link.robot} has no base running: `cocoro status` tells more")
        state, health = link.latest(BASE_STATE), link.latest(HEALTH.of("base"))
        changed = asyncio.Event()
        link.inbox(BASE_STATE).add(lambda _key, _message: changed.set())
        link.inbox(HEALTH.of("base")).add(lambda _key, _message: changed.set())
        await within(HEARD_S, lambda: state.value is not None and health.value is not None, changed)
        told, well = state.value, health.value
    if as_json:
        print(json.dumps({"state": msgspec.to_builtins(told), "faults": list(well.faults) if well else []}))
    else:
        _print(told, well)
    return exits.DONE if told is not None and well is not None and not well.faults else exits.FAILED


def _print(state: BaseState | None, health: Health | None) -> None:
    if state is None:
        print("base       nothing is heard of it")
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
    for fault in health.faults if health else ():
        print(f"fault      {fault}")


async def recover(where: RobotChoice) -> int:
    async with joined(where) as link:
        reply = await link.call(RECOVER, RecoverRequest())
        robot = link.robot
    if not reply.recovered:
        print(f"{robot}: the base does not recover: {reply.text}")
        return exits.REFUSED
    print(f"{robot}: the base obeys")
    return exits.DONE
