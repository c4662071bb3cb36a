"""`cocoro servos clear`, `relax` and `hold`: what the running service is asked."""

from __future__ import annotations

import sys
from typing import cast

from apps.cli import exits
from apps.cli.link import Link, joined
from apps.cli.options import RobotChoice
from cocoro.errors import ConfigError, MeshError
from cocoro.messages import ServoRequest
from cocoro.robot import Robot
from cocoro.topics import SERVOS

NETWORKS = ("arm", "hand")
DID = {"clear": "cleared", "relax": "limp", "hold": "holding"}


async def ask(where: RobotChoice, action: str, joints: list[str]) -> int:
    """Ask the networks that have these joints. Exit code 3 when something could not be done."""
    networks = _networks_of(joints)
    code = exits.DONE
    async with joined(where) as link:
        alive = await link.alive()
        missing = [network for network in networks if network not in alive]
        if missing:
            raise MeshError(f"{link.robot} has no {missing[0]} running: `cocoro status` tells more")
        for network, named in networks.items():
            code = max(code, await _ask_one(link, network, action, named))
    return code


async def _ask_one(link: Link, network: str, action: str, joints: list[str]) -> int:
    request = ServoRequest(action=action, joints=tuple(joints))  # type: ignore[arg-type] # one of three, by the command
    try:
        reply = await link.call(SERVOS.of(network), request)
    except MeshError as error:
        raise MeshError(f"{network} does not answer this: is it simulated? Only real servos have it") from error
    print(f"{network}: {DID[action]}: {', '.join(reply.joints) or 'none'}")
    if reply.text:
        print(f"cocoro: {network}: {reply.text}", file=sys.stderr)
        return exits.REFUSED
    return exits.DONE


def _networks_of(joints: list[str]) -> dict[str, list[str]]:
    """Which joints to name to which network; none is all of both. Raises ConfigError for one that there is not."""
    known = Robot.load().joints
    if unknown := [joint for joint in joints if joint not in known]:
        raise ConfigError(f"there is no joint {unknown[0]!r}; there are {', '.join(known)}")
    if not joints:
        return {network: [] for network in NETWORKS}
    found: dict[str, list[str]] = {}
    for joint in joints:
        found.setdefault(cast(str, known[joint].network), []).append(joint)
    return found
