"""The learned model on disk and on the mesh: one JSON document with a checksum.

It names its version, its robot, the fingerprint of the robot description it was learned with, its training data and its
scores. A document that is damaged, of another robot or of another version is refused with one line that says which.
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


class Training(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Training data and scores."""

    data: str
    """Fingerprint of the samples."""
    samples: Annotated[int, Meta(ge=0)]
    method: str
    scores: dict[str, float]
    """By name, which ends with the unit: held_out_rms_m, drawing_offset_rms_m."""


class ArmModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The hand-eye map."""

    joints: tuple[str, ...]
    roll_rad: Weight
    over_drawing: bool
    """The network adds to the nominal model; else it is the whole map."""
    coordinates: Coordinates
    centres: list[list[Weight]]
    widths: list[Annotated[float, Meta(gt=0, le=100)]]
    weights: list[list[Weight]]
    normalised: bool = True
    """The activations of the network's bases add up to one."""
    seen_m: list[FiniteVec3]
    """Positions where the hand was seen; the reachability mesh is made of them."""
    training: Training


class WheelModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The learned wheel distance and camera tilt."""

    separation_m: Annotated[float, Meta(gt=0.01, lt=10)]
    eye_tilt_rad: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0
    """Angle at the neck by which the camera sees things higher than they are."""
    training: Training


class BodyModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The learned parts; the nominal model replaces a missing one."""

    robot: str
    drawing: str
    """Fingerprint of the robot description that it was learned with (`fingerprint_of`)."""
    arm: ArmModel | None = None
    wheels: WheelModel | None = None


class _Document(msgspec.Struct, frozen=True, kw_only=True):
    format: str
    version: int
    checksum: str
    """First 16 hex digits of the SHA-256 of `model`'s bytes."""
    model: msgspec.Raw


def empty(robot: Robot) -> BodyModel:
    """A model without parts."""
    return BodyModel(robot=robot.name, drawing=fingerprint_of(robot))


def encode(model: BodyModel) -> bytes:
    """The document of a model, as files and messages carry it."""
    body = msgspec.json.encode(model)
    checksum = hashlib.sha256(body).hexdigest()[:16]
    return msgspec.json.encode(_Document(format=FORMAT, version=VERSION, checksum=checksum, model=msgspec.Raw(body)))


def decode(data: bytes, robot: Robot, where: str) -> BodyModel:
    """Read a document of `encode`; `where` it is from. Raises ConfigError: damaged, another robot's or version."""
    try:
        document = msgspec.json.decode(data, type=_Document)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"model {where}: it is damaged or no model ({error})") from error
    if document.format != FORMAT:
        raise ConfigError(f"model {where}: it is a {document.format!r}, not a {FORMAT}")
    if document.version != VERSION:
        age = "an older" if document.version < VERSION else "a newer"
        raise ConfigError(
            f"model {where}: it has {age} version, {document.version}; this program reads version {VERSION}:"
            " learn it again (`cocoro learn`)"
        )
    if hashlib.sha256(bytes(document.model)).hexdigest()[:16] != document.checksum:
        raise ConfigError(f"model {where}: it is damaged (its checksum is wrong): learn it again (`cocoro learn`)")
    try:
        model = msgspec.json.decode(document.model, type=BodyModel)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"model {where}: {error}") from error
    if model.robot != robot.name:
        raise ConfigError(f"model {where}: it is of robot {model.robot!r}, this one is {robot.name!r}")
    if model.drawing != fingerprint_of(robot):
        raise ConfigError(
            f"model {where}: it was learned with another description of {robot.name}: learn it again (`cocoro learn`)"
        )
    if model.arm is not None:
        hand_map(model.arm, robot, where)
    return model


def load(path: Path, robot: Robot) -> BodyModel:
    """Read a file. Raises ConfigError like `decode`, or when the file cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"model {path}: {error.strerror}") from error
    return decode(data, robot, str(path))


def save(model: BodyModel, path: Path) -> None:
    """Replace the file as a whole. Raises ConfigError when it cannot be written."""
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
    """The arm's part of a model. `seen_m`: positions (b, 3), body frame, metres, where the marker was seen."""
    network = learned.network
    return ArmModel(
        joints=learned.joints,
        roll_rad=roll_rad,
        over_drawing=learned.over_nominal,
        coordinates=learned.coordinates,
        centres=network.centres.tolist(),
        widths=network.widths.tolist(),
        weights=network.weights.tolist(),
        normalised=network.normalised,
        seen_m=[(x, y, z) for x, y, z in np.round(seen_m, 4).tolist()],
        training=training,
    )


def hand_map(arm: ArmModel, robot: Robot, where: str = "arm") -> HandMap:
    """The map, ready for computing. Raises ConfigError when its parts do not fit together."""
    nominal = NominalModel(robot, arm.roll_rad)
    try:
        centres, weights = np.array(arm.centres), np.array(arm.weights)
        network = HyperplaneRbf(centres, np.array(arm.widths), 3, normalised=arm.normalised)
        if weights.shape != network.weights.shape or arm.joints != nominal.joints:
            raise ValueError(f"weights {weights.shape} for joints {', '.join(arm.joints)}")
    except ValueError as error:
        raise ConfigError(f"model {where}: its parts do not fit together: {error}") from error
    network.weights = weights
    return HandMap(nominal, network, over_nominal=arm.over_drawing, coordinates=arm.coordinates)
