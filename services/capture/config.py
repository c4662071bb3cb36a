"""The recorder's configuration: the `[service.capture]` table of a profile."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.capture.folder import default_folder
from cocoro.units import Positive
from services.capture.packing import Compression


class CaptureConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    folder: str | None = None
    """Folder of the files; created when it is missing. Default: $COCORO_CAPTURE_DIR, else `cocoro/captures` in
    $XDG_STATE_HOME (~/.local/state)."""
    file: str | None = None
    """One file for everything instead, without rotation. It must not exist yet."""
    only: tuple[str, ...] = ()
    """Key expressions, with or without the robot's name, or `frames`. Empty: everything."""
    without: tuple[str, ...] = ()
    """As `only`, for keys to leave out; overrides `only`."""

    compression: Compression = "zstd"
    """Lossless compression of chunks. A chunk that does not shrink is stored uncompressed."""
    level: Annotated[int, Meta(ge=0, le=19)] = 1
    """zstd level: 1 is fast, 19 thorough and slow. Small messages have at least 3. 0 stores what repeats nowhere as it
    is: frames of noisy sensors then take 0.65 of the time and 1.4 times the room, ideal ones 0.95 and 1.06."""
    jpeg_quality: Annotated[int, Meta(ge=1, le=100)] | None = None
    """Store the frames' colour as JPEG of this quality: far smaller, but perception cannot be re-executed from it."""

    per_occasion: bool = True
    """A new file starts when a task, a stop, a fault or motion begins, with the seconds before it, and after its end.
    Has no effect with `file`."""
    idle_period_s: Annotated[float, Meta(ge=0)] = 30.0
    """While nothing happens, one frame in this time is recorded, and one of any other large message; 0: all of them.
    Has no effect without `per_occasion`."""
    before_s: Annotated[float, Meta(ge=0, le=3)] = 3.0
    """Seconds of everything that are kept in memory, for the file of the next occasion."""
    before_mb: Positive = 100.0
    """Limit of that memory. 3 s of 30 frames of 640 x 480 take 58 to 73 MB with noisy sensors: they wait packed."""

    rotate_mb: Positive = 2000.0
    rotate_s: Positive = 600.0
    """A new file starts at this size or length, whichever comes first."""
    idle_rotate_s: Positive = 3600.0
    """The same, of files in which nothing happens."""
    keep_gb: Positive | None = None
    """With each new file captures of this robot are deleted until those in the folder take no more: first those in
    which nothing happened, then those of mere motion, last those with a task, a stop or a fault; the oldest first."""
    min_free_mb: Annotated[float, Meta(ge=0)] = 500.0
    """Recording stops before it leaves less room on the disk."""

    memory_mb: Positive = 128.0
    """Limit for messages that wait for the disk. Beyond it messages are dropped, large ones first, and counted."""
    flush_s: Annotated[float, Meta(gt=0, le=0.2)] = 0.1
    """When this process dies, the messages of about this time are lost."""
    sync_s: Annotated[float, Meta(gt=0, le=0.8)] = 0.5
    """When power fails, the messages of about this time are lost, and those of the disk's last sync."""


def folder_of(config: CaptureConfig) -> Path:
    return default_folder() if config.folder is None else Path(config.folder)
