"""`cocoro objects`: the objects that the robot knows, and where it saw each last."""

from __future__ import annotations

import json

import msgspec

from apps.cli import exits
from apps.cli.link import joined
from apps.cli.options import RobotChoice
from apps.cli.terminal import print_table
from cocoro.messages import KnownObject, ObjectsRequest
from cocoro.topics import OBJECTS


async def objects(where: RobotChoice, as_json: bool) -> int:
    async with joined(where) as link:
        reply = await link.call(OBJECTS, ObjectsRequest())
    if as_json:
        print(json.dumps(msgspec.to_builtins(reply.objects)))
    else:
        print_table(("object", "shape", "size (cm)", "graspable", "seen"), [_row(known) for known in reply.objects])
    return exits.DONE


def _row(known: KnownObject) -> tuple[str, ...]:
    size = " x ".join(f"{100 * side:.1f}" for side in known.size_m)
    seen = "-"
    if known.seen is not None:
        x_m, y_m, z_m = known.seen.position_m
        seen = f"{known.seen.age_s:.1f} s ago at ({x_m:.2f}, {y_m:.2f}, {z_m:.2f}) m"
    return known.label, known.shape, size, "yes" if known.graspable else "no", seen
