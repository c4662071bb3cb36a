"""Samples of babbling on disk: JSON lines that any tool reads, appended one by one, valid after any kind of end.

The first line is the header: format, version, robot, fingerprint of the robot description that the positions were
computed with, joints, units. Each further line is one row. Rows are written unbuffered and only whole lines count, so a
process that is killed loses at most an unfinished line, which is cut off when the file is next appended to.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Generic, TypeVar

import msgspec

from cocoro.errors import ConfigError, RefusedError
from cocoro.learning.handmap import fingerprint_of
from cocoro.messages import FiniteVec2, FiniteVec3
from cocoro.robot import Robot

VERSION = 1
HAND, WHEELS = "cocoro.hand-samples", "cocoro.wheel-trials"


class HandRow(msgspec.Struct, frozen=True, kw_only=True):
    """One sighting of the hand's marker."""

    stamp_ns: int
    """The frame's."""
    draw: int
    """Number of the Sobol draw that the arm moved to; rows of one draw are near one another."""
    angles_rad: tuple[float, ...]
    """Angles of the header's joints at the frame's stamp."""
    head_rad: FiniteVec2
    """Pan and tilt at the frame's stamp."""
    seen_m: FiniteVec3
    """The marker's centre, body frame: what the camera saw, transformed by the nominal model of the neck."""
    area_px: int


class WheelRow(msgspec.Struct, frozen=True, kw_only=True):
    """One trial of wheel babbling: the target is seen, both wheels turn for a time, the target is seen again."""

    stamp_ns: int
    """The trial's end."""
    trial: int
    left_mps: float
    right_mps: float
    """The commanded speeds."""
    left_m: float
    right_m: float
    """Travel of each wheel by the base's odometry."""
    before_m: FiniteVec2
    after_m: FiniteVec2
    """The target's (x, y), body frame; each is the mean of several frames while the robot stood."""
    turned_rad: float
    """The turn by the base's own odometry."""
    height_m: float | None = None
    """Seen height of the target's centre above the floor, at the end."""


class Header(msgspec.Struct, frozen=True, kw_only=True):
    format: str
    version: int
    robot: str
    drawing: str
    """Fingerprint of the robot description (`fingerprint_of`)."""
    joints: tuple[str, ...] = ()
    roll_rad: float = 0.0
    """The wrist roll during babbling (hand samples)."""
    target_height_m: float | None = None
    """True height of the target's centre above the floor, if known (wheel trials)."""
    units: str = "rad, m, m/s, ns; body frame: x forward, y left, z up, origin on the floor between the wheels"


SampleRow = TypeVar("SampleRow", bound=HandRow | WheelRow)


class Recorded(Generic[SampleRow]):
    """The content of a file."""

    def __init__(self, path: Path, header: Header, rows: list[SampleRow]) -> None:
        self.path = path
        self.header = header
        self.rows = rows

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the rows, independent of the order of keys on disk."""
        digest = hashlib.sha256()
        for row in self.rows:
            digest.update(msgspec.json.encode(row))
        return digest.hexdigest()[:16]


def read(path: Path, kind: type[SampleRow], robot: Robot | None = None) -> Recorded[SampleRow]:
    """Read a file of one kind of rows. Raises ConfigError, naming file and line, when it is none, is damaged, or (with
    `robot`) is another robot's."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"samples {path}: {error.strerror}") from error
    return _parse(path, data, kind, robot)


def _parse(path: Path, data: bytes, kind: type[SampleRow], robot: Robot | None) -> Recorded[SampleRow]:
    lines = data[: data.rfind(b"\n") + 1].splitlines()  # a line without an end was being written
    if not lines:
        raise ConfigError(f"samples {path}: it is empty; babble into a new file")
    header = _header(path, lines[0], kind)
    if robot is not None and header.robot != robot.name:
        raise ConfigError(f"samples {path}: they are of robot {header.robot!r}, this one is {robot.name!r}")
    if robot is not None and header.drawing != fingerprint_of(robot):
        raise ConfigError(f"samples {path}: they were taken with another description of {robot.name}: babble again")
    decoder = msgspec.json.Decoder(kind)
    rows: list[SampleRow] = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            row = decoder.decode(line)
        except msgspec.MsgspecError as error:
            raise ConfigError(f"samples {path}, line {number}: {error}") from error
        if isinstance(row, HandRow) and len(row.angles_rad) != len(header.joints):
            raise ConfigError(f"samples {path}, line {number}: angles_rad must have {len(header.joints)} values")
        rows.append(row)
    return Recorded(path, header, rows)


def _header(path: Path, line: bytes, kind: type[SampleRow]) -> Header:
    wanted = HAND if kind is HandRow else WHEELS
    try:
        header = msgspec.json.decode(line, type=Header)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"samples {path}: it is not a file of samples ({error})") from error
    if header.format != wanted:
        raise ConfigError(f"samples {path}: it holds {header.format}, not {wanted}")
    if header.version != VERSION:
        raise ConfigError(f"samples {path}: it is of version {header.version}, this program reads version {VERSION}")
    return header


class SampleFile(Generic[SampleRow]):
    """Appends to a file, or begins it. Use it with `with`.

    Raises ConfigError when the file cannot be written or holds something else (another robot's samples, say), and
    RefusedError when another process is writing it.
    """

    def __init__(self, path: Path, kind: type[SampleRow], robot: Robot, header: Header) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a+b", buffering=0)
        except OSError as error:
            raise ConfigError(f"samples {path}: {error.strerror}") from error
        try:
            self._lock()
            self.rows: list[SampleRow] = self._resume(kind, robot, header)
            """All rows of the file, those from before included."""
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> SampleFile[SampleRow]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.fsync(self._file.fileno())
        self._file.close()

    def append(self, rows: Iterable[SampleRow]) -> None:
        """Write rows at once: when this returns they outlive the process. Raises OSError with the file's name."""
        added = list(rows)
        self._write(b"".join(msgspec.json.encode(row) + b"\n" for row in added))
        self.rows += added

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:  # a disk that is filling takes a part, and says so with the next
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            error.filename = str(self.path)
            raise

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RefusedError(f"samples {self.path}: another process is writing it") from error

    def _resume(self, kind: type[SampleRow], robot: Robot, header: Header) -> list[SampleRow]:
        self._file.seek(0)
        data = self._file.read()
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            self._file.truncate(whole)  # the line that was being written when the last process ended
        if not whole:
            self._write(msgspec.json.encode(header) + b"\n")
            return []
        found = _parse(self.path, data, kind, robot)
        if (found.header.joints, found.header.roll_rad) != (header.joints, header.roll_rad):
            raise ConfigError(f"samples {self.path}: they were taken with other joints; babble into a new file")
        return found.rows


def hand_header(robot: Robot, joints: tuple[str, ...], roll_rad: float) -> Header:
    return Header(
        format=HAND, version=VERSION, robot=robot.name, drawing=fingerprint_of(robot), joints=joints, roll_rad=roll_rad
    )


def wheel_header(robot: Robot, target_height_m: float | None = None) -> Header:
    return Header(
        format=WHEELS, version=VERSION, robot=robot.name, drawing=fingerprint_of(robot), target_height_m=target_height_m
    )
