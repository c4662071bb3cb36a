"""A file that an export makes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cocoro.capture.conventions import CaptureError
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture


def refuse_existing(out: Path) -> None:
    """An export writes over nothing: it might be the capture. Raises CaptureError."""
    if out.exists():
        raise CaptureError(f"{out} is there already; remove it, or choose another name")


@contextmanager
def making(out: Path) -> Iterator[None]:
    """While a file is made; one that failed does not stay. Raises CaptureError where none can be made."""
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
"""Characters: file systems take 255 bytes."""


def export_attachments(capture: Capture, folder: Path) -> int:
    """Write each attachment into the folder under its own name, made one that a file can have there; a name that is
    there twice has a number the second time. Returns how many were written; a damaged one is told in
    `capture.problems`. Raises CaptureError when one cannot be written, or is there already."""
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
    """An attachment's name as that of a file in one folder: whoever wrote the capture chooses no other place."""
    plain = re.sub(r"[\x00-\x1f\x7f]", "_", name.replace("\\", "/").rstrip("/").rpartition("/")[2])[-LONGEST_NAME:]
    while len(plain.encode()) > LONGEST_NAME:
        plain = plain[1:]
    return plain if plain.strip(". ") else "attachment"


def _free(name: str, taken: set[str]) -> str:
    """The name, or with a number where it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        stem, dot, ending = name.rpartition(".")
        free = f"{stem}-{number}{dot}{ending}" if stem else f"{name}-{number}"
    taken.add(free)
    return free
