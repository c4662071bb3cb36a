"""What was learned, on disk and on the mesh: one JSON document, checked before it is believed.

It says its version, its robot, the drawing that it stands on, what it was trained on and how good it is. A document
that is damaged, foreign or of another version is refused with one line that says which.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from cocoro.arrays import FloatArray
from cocoro.errors import ConfigError
from cocoro.learning.handmap import Coordinates, HandMap, NominalModel, fingerprint_of
from cocoro.learning.network import HyperplaneRbf
from cocoro.messages import FiniteVec3
from cocoro.robot import Robot

FORMAT = "cocoro.model"
VERSION = 1
LARGEST_WEIGHT = 1e6

Weight = Annotated[float, Meta(ge=-LARGEST_WEIGHT, le=LARGEST_WEIGHT)]
BoundedNonNegative = Annotated[float, Meta(ge=0, le=LARGEST_WEIGHT)]


class Training(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What it was learned from, and how good it was found to be."""

    data: str
    """Fingerprint of the samples."""
    samples: Annotated[int, Meta(ge=0)]
    method: str
    scores: dict[str, float]
    """By name, with the unit in it: held_out_rms_m, drawing_offset_rms_m."""


class ArmModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The hand-eye map."""

    joints: tuple[str, ...]
    roll_rad: Weight
    over_drawing: bool
    coordinates: Coordinates
    centres: list[list[Weight]]
    widths: list[Annotated[float, Meta(gt=0, le=100)]]
    weights: list[list[Weight]]
    seen_m: list[FiniteVec3]
    """Where the hand was seen: what the reachability mesh is made of."""
    training: Training


class WheelModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    separation_m: Annotated[float, Meta(gt=0.01, lt=10)]
    eye_tilt_rad: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0
    """By how much the eye sees things higher than they are, as an angle at the neck."""
    training: Training


class BodyModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Each part may be missing: then the drawing's own serves."""

    robot: str
    drawing: str
    """Fingerprint of the robot description that it stands on."""
    arm: ArmModel | None = None
    wheels: WheelModel | None = None


class _Document(msgspec.Struct, frozen=True, kw_only=True):
    format: str
    version: int
    checksum: str
    """Of `model`'s bytes as they stand."""
    model: msgspec.Raw


def empty(robot: Robot) -> BodyModel:
    """Nothing learned yet."""
    return BodyModel(robot=robot.name, drawing=fingerprint_of(robot))


def encode(model: BodyModel) -> bytes:
    body = msgspec.json.encode(model)
    checksum = hashlib.sha256(body).hexdigest()[:16]
    return msgspec.json.encode(_Document(format=FORMAT, version=VERSION, checksum=checksum, model=msgspec.Raw(body)))


def decode(data: bytes, robot: Robot, where: str) -> BodyModel:
    """Read what `encode` gave. Raises ConfigError with one line: damaged, foreign, or of another version."""
    try:
        document = msgspec.json.decode(data, type=_Document)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"model {where}: it is damaged, or no model at all ({error})") from error
    if document.format != FORMAT:
        raise ConfigError(f"model {where}: it is a {document.format!r}, not a {FORMAT}")
    if document.version != VERSION:
        age = "an older" if document.version < VERSION else "a newer"
        raise ConfigError(
            f"model {where}: it is of {age} version, {document.version}; this program reads version {VERSION}:"
            " learn it anew (cocoro learn)"
        )
    if hashlib.sha256(bytes(document.model)).hexdigest()[:16] != document.checksum:
        raise ConfigError(f"model {where}: it is damaged (its checksum is wrong): learn it anew (cocoro learn)")
    try:
        model = msgspec.json.decode(document.model, type=BodyModel)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"model {where}: {error}") from error
    if model.robot != robot.name:
        raise ConfigError(f"model {where}: it is of robot {model.robot!r}, this one is {robot.name!r}")
    if model.drawing != fingerprint_of(robot):
        raise ConfigError(f"model {where}: it stands on another description of {robot.name}: learn it anew")
    if model.arm is not None:
        hand_map(model.arm, robot, where)
    return model


def load(path: Path, robot: Robot) -> BodyModel:
    """Raises ConfigError as `decode` does, or when the file cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"model {path}: {error.strerror}") from error
    return decode(data, robot, str(path))


def save(model: BodyModel, path: Path) -> None:
    """Write it whole or not at all. Raises ConfigError when it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.{os.getpid()}")
        with beside.open("wb") as file:
            file.write(encode(model))
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise ConfigError(f"model {path}: {error.strerror}") from error


def arm_model(learned: HandMap, roll_rad: float, seen_m: FloatArray, training: Training) -> ArmModel:
    network = learned.network
    return ArmModel(
        joints=learned.joints,
        roll_rad=roll_rad,
        over_drawing=learned.over_nominal,
        coordinates=learned.coordinates,
        centres=network.centres.tolist(),
        widths=network.widths.tolist(),
        weights=network.weights.tolist(),
        seen_m=[(x, y, z) for x, y, z in np.round(seen_m, 4).tolist()],
        training=training,
    )


def hand_map(arm: ArmModel, robot: Robot, where: str = "arm") -> HandMap:
    """The map, ready to compute with. Raises ConfigError where its parts do not fit together."""
    nominal = NominalModel(robot, arm.roll_rad)
    try:
        centres, weights = np.array(arm.centres), np.array(arm.weights)
        network = HyperplaneRbf(centres, np.array(arm.widths), 3)
        if weights.shape != network.weights.shape or arm.joints != nominal.joints:
            raise ValueError(f"weights {weights.shape} for joints {', '.join(arm.joints)}")
    except ValueError as error:
        raise ConfigError(f"model {where}: its parts do not fit together: {error}") from error
    network.weights = weights
    return HandMap(nominal, network, over_nominal=arm.over_drawing, coordinates=arm.coordinates)
