"""Whether a recording of fakenect's is whole, before its player reads it: that reads beyond what is there."""

from __future__ import annotations

import os
from collections.abc import Iterator

from services.kinect.freenect import COLOUR_BYTES, DEPTH_BYTES, DeviceError

INDEX = "INDEX.txt"
BYTES = {"r": COLOUR_BYTES, "d": DEPTH_BYTES}
LONGEST_HEADER = 64
"""One line of a PPM or PGM."""


def check(folder: str) -> None:
    """Raises DeviceError that names the file, and says what to do."""
    index = os.path.join(folder, INDEX)  # noqa: PTH118 # as in all of this process: pathlib is slow to import
    try:
        with open(index, encoding="utf-8") as file:  # noqa: PTH123
            names = file.read().splitlines()
    except (OSError, UnicodeDecodeError):
        raise DeviceError(f"{folder} is no recording: there is no readable {INDEX} in it") from None
    if not {"r", "d"} <= {name[:1] for name in names}:
        raise DeviceError(f"{index} names no colour or no depth pictures: the recording holds nothing to play")
    for fault in _faults(folder, names):
        raise DeviceError(f"{fault}: record anew, or take its line out of {index}")


def _faults(folder: str, names: list[str]) -> Iterator[str]:
    for name in names:
        path = os.path.join(folder, name)  # noqa: PTH118
        if not name:
            yield f"{folder}: an empty line stands in {INDEX}"
        elif not _is_named_well(name):
            yield f"{path} has no name of a recording's"
        else:
            yield from _wrong_size(path, name[0])


def _is_named_well(name: str) -> bool:
    """TYPE-SECONDS-TICKS.anything."""
    parts = name.split(".pgm")[0].split(".ppm")[0].split(".dump")[0].split("-")
    try:
        return len(parts) == 3 and parts[0] in ("r", "d", "a") and float(parts[1]) >= 0 and int(parts[2]) >= 0
    except ValueError:
        return False


def _wrong_size(path: str, kind: str) -> Iterator[str]:
    try:
        with open(path, "rb") as file:  # noqa: PTH123
            header = file.readline(LONGEST_HEADER)
            size = file.seek(0, os.SEEK_END)
    except OSError as error:
        yield f"{path} cannot be read ({error.strerror})"
        return
    if kind not in BYTES:
        if size == 0:
            yield f"{path} is empty"
    elif not header.endswith(b"\n") or size != len(header) + BYTES[kind]:
        yield f"{path} is damaged: its pixels take {size - len(header)} bytes, not {BYTES[kind]}"
