"""Files that an export makes, and `--attachments`: the files attached to a capture."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cocoro.capture.conventions import CaptureError
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture


def refuse_existing(out: Path) -> None:
    """Raises CaptureError when the file exists. An export overwrites nothing: it might be the capture."""
    if out.exists():
        raise CaptureError(f"{out} exists; remove it, or choose another name")


@contextmanager
def making(out: Path) -> Iterator[None]:
    """Context for making a file; when it fails the file is removed. Raises CaptureError when none can be made there."""
    refuse_existing(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.touch()
    except OSError as error:
        raise CaptureError(f"{out}: {error.strerror}") from error
    try:
        out.unlink()
        yield
    except BaseException:
        out.unlink(missing_ok=True)
        raise


LONGEST_NAME = 200
"""Characters. File systems allow 255 bytes."""


def export_attachments(capture: Capture, folder: Path) -> int:
    """Write each attachment into the folder, under its own name as far as that is a file name; a repeated name gets a
    number.

    Returns the number of files. Damaged attachments are added to `capture.problems`. Raises CaptureError when a
    file cannot be written or exists.
    """
    taken: set[str] = set()
    written = 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for index in capture.attachments:
            path = folder / _free(file_name(index.name), taken)
            refuse_existing(path)
            try:
                data = capture.attachment(index).data
            except DamageError as damage:
                capture.add_problem(f"at byte {index.offset}: {damage}")
                continue
            path.write_bytes(data)
            written += 1
    except OSError as error:
        raise CaptureError(f"{error.filename or folder}: {error.strerror}") from error
    return written


def file_name(name: str) -> str:
    """An attachment's name as a plain file name, so that a capture cannot choose another folder."""
    plain = re.sub(r"[\x00-\x1f\x7f]", "_", name.replace("\\", "/").rstrip("/").rpartition("/")[2])[-LONGEST_NAME:]
    while len(plain.encode()) > LONGEST_NAME:
        plain = plain[1:]
    return plain if plain.strip(". ") else "attachment"


def _free(name: str, taken: set[str]) -> str:
    """The name, with a number when it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        stem, dot, ending = name.rpartition(".")
        free = f"{stem}-{number}{dot}{ending}" if stem else f"{name}-{number}"
    taken.add(free)
    return free
