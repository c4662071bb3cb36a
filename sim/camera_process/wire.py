"""What the camera's process and its owner exchange: messages in MessagePack, and slots of shared memory.

A slot holds one exposure: the poses of the visuals and of the camera, then the picture.
"""

from __future__ import annotations

import mmap
from typing import Any, NamedTuple

import msgspec
import numpy as np

from cocoro.arrays import FloatArray, ImageArray
from cocoro.units import Vec3
from sim.kinds import Sensors
from sim.render.choice import RendererChoice
from sim.render.interface import Visual

MESSAGE_BYTES = 1 << 17
"""Upper bound of a message; the largest is the setup, with the robot's description."""
_PAGE = 4096


class Setup(msgspec.Struct, frozen=True):
    """The first message to the process, with the file descriptor of the shared memory beside it."""

    robot: dict[str, Any]
    """`Robot.to_data` of the robot that the camera is on."""
    visuals: list[Visual]
    sensors: Sensors
    seed: int
    width: int
    height: int
    renderer: RendererChoice
    slots: int


class Exposure(msgspec.Struct, frozen=True, array_like=True):
    """Take a picture of the poses in a slot. The light's fields are those of `sim.render.Lighting`."""

    slot: int
    stamp_ns: int
    ambient: float
    diffuse: float
    direction: Vec3
    temperature_k: float


class Taken(msgspec.Struct, frozen=True, array_like=True):
    """The answer to an exposure. The answers come in the order of the exposures."""

    slot: int
    """Where the picture is."""
    warnings: tuple[str, ...] = ()
    """What was logged since the last answer."""
    error: str = ""
    """Why there is no picture; '' when there is one."""


class Slot(NamedTuple):
    """Views of the memory of one slot."""

    poses: FloatArray
    """World poses of the visuals, (n, 4, 4)."""
    camera_pose: FloatArray
    """(4, 4)."""
    colour: ImageArray
    """The bytes of `Frame.colour`, (3 * pixels,)."""
    depth: ImageArray
    """The bytes of `Frame.depth`, (2 * pixels,)."""


def slots_of(memory: mmap.mmap, setup: Setup) -> list[Slot]:
    """The slots in the shared memory, which has `memory_bytes(setup)` bytes."""
    count, pixels = len(setup.visuals), setup.width * setup.height
    slots = []
    for start in range(0, memory_bytes(setup), _slot_bytes(setup)):
        numbers = np.frombuffer(memory, np.float64, 16 * (count + 1), start).reshape(count + 1, 4, 4)
        picture = np.frombuffer(memory, np.uint8, 5 * pixels, start + numbers.nbytes)
        slots.append(Slot(numbers[:count], numbers[count], picture[: 3 * pixels], picture[3 * pixels :]))
    return slots


def memory_bytes(setup: Setup) -> int:
    return setup.slots * _slot_bytes(setup)


def _slot_bytes(setup: Setup) -> int:
    """A whole number of pages, so that no two slots share one."""
    used = 128 * (len(setup.visuals) + 1) + 5 * setup.width * setup.height
    return -(-used // _PAGE) * _PAGE
