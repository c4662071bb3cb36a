"""`cocoro.rehearse`: a program on a whole simulated robot, in this process and in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AsyncExitStack
from typing import Any, TypeVar

import msgspec

from apps.client.connecting import connect
from apps.client.robot import RobotClient
from apps.rehearsal.rehearse import PROCESSES, START_S
from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.component import load
from cocoro.errors import CocoroError, ConfigError, choice_of, field_text
from cocoro.node import Node
from cocoro.robot_files import RobotFiles, scene_beside
from cocoro.vloop import run_virtual
from deploy.processes import named, needs
from deploy.which_robot import files_of
from sim.scene_names import DEFAULT

T = TypeVar("T")
Program = Callable[[RobotClient], Awaitable[T]]


def rehearse(
    program: Program[T],
    *,
    robot: str | None = None,
    scene: str = DEFAULT,
    seed: int = 0,
    sensors: str = "ideal",
    frames: tuple[int, int, float] = (320, 240, 15.0),
    settings: Mapping[str, Mapping[str, Any]] | None = None,
) -> T:
    """Runs `program(robot)`, the same as for a real robot, and returns its result.

    The real services and the simulator run in this process; time goes on while the program waits, as fast as the
    computer can, and equal arguments give equal results. `robot` is one that the project ships, one that is up here, or
    the file of its description; the Calliope by default. `scene` is a scene's name or file, `sensors` 'ideal' or
    'real', `frames` the camera's width and height, px, and rate, Hz. `settings` are those of services, by name, as a
    profile has them.

    Call it where no event loop runs. Raises what the program raises, and ConfigError for wrong settings.
    """
    width, height, frame_rate_hz = frames
    files = files_of(robot)
    world = {
        "scene": str(scene_beside(files.description, scene) or scene), "seed": seed, "sensors": sensors,
        "width": width, "height": height, "frame_rate_hz": frame_rate_hz,
    }  # fmt: skip
    given = {"sim": {}, **(settings or {})}
    unknown = sorted(set(given) - set(PROCESSES))
    if unknown:
        raise ConfigError(f"rehearse: no service {unknown[0]!r}; {choice_of(unknown[0], PROCESSES)}")
    return run_virtual(_run(program, {**given, "sim": {**world, **given["sim"]}}, files))


async def _run(program: Program[T], settings: Mapping[str, Mapping[str, Any]], files: RobotFiles) -> T:
    mesh, clock, robot = LocalMesh(), VirtualClock(), files.load()
    async with AsyncExitStack() as stack:
        services = []
        for name in PROCESSES:
            row = named(name)
            component = load(row)
            fields = component.config.__struct_fields__
            filled: dict[str, Any] = {"needed": needs(name)} if "needed" in fields else {}
            if files.objects is not None and "objects" in fields:
                filled["objects"] = str(files.objects)
            try:
                config = msgspec.convert({**filled, **settings.get(name, {})}, component.config)
            except msgspec.ValidationError as error:
                raise ConfigError(f"rehearse: {name}: {field_text(error, component.config)}") from error
            node = Node(name, mesh.join(), clock, robot, module=row.module, config=config)
            await stack.enter_async_context(node)
            services.append(asyncio.ensure_future(component.run(node, config)))
        work = asyncio.ensure_future(_operate(program, mesh, robot.name))
        try:
            await asyncio.wait((work, *services), return_when=asyncio.FIRST_COMPLETED)
            for service in services:
                if service.done():
                    service.result()
                    raise CocoroError("a service of the rehearsal ended by itself")
            return work.result()
        finally:
            for future in (work, *services):
                future.cancel()
            await asyncio.gather(work, *services, return_exceptions=True)


async def _operate(program: Program[T], mesh: LocalMesh, name: str) -> T:
    async with connect(name, bus=mesh.join(), clock=VirtualClock()) as robot:
        async with asyncio.timeout(START_S):
            while not (await robot.status()).ready:  # noqa: ASYNC110 # time itself goes on
                await asyncio.sleep(0.1)
        return await program(robot)
