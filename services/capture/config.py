"""What of the mesh is recorded, and where to; a profile's `[service.capture]` table sets these."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.units import Positive
from services.capture.file import Compression

FOLDER = "COCORO_CAPTURE_DIR"
"""Environment variable: where captures go when the configuration does not say."""


class CaptureConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    folder: str | None = None
    """Where the files go, one after another; made when it is not there. By default $COCORO_CAPTURE_DIR, else
    `cocoro/captures` in $XDG_STATE_HOME (~/.local/state)."""
    file: str | None = None
    """All into this one file instead, which must not be there yet; then nothing is rotated."""
    only: tuple[str, ...] = ()
    """Key expressions, with or without the robot's name, or `frames`; none means everything."""
    without: tuple[str, ...] = ()
    """Likewise; stronger than `only`."""

    compression: Compression = "zstd"
    """Of chunks, without loss. What does not shrink by it is stored as it is."""
    level: Annotated[int, Meta(ge=1, le=19)] = 1
    """Of zstd: 1 is quick, 19 is thorough and slow."""
    jpeg_quality: Annotated[int, Meta(ge=1, le=100)] | None = None
    """Keep the frames' colour as JPEG, with loss: far smaller, good to look at, no use to execute perception anew."""

    rotate_mb: Positive = 2000.0
    rotate_s: Positive = 600.0
    """A new file is begun at this size or length, whichever comes first."""
    keep_gb: Positive | None = None
    """With every new file the oldest of this robot's captures in the folder are deleted until the rest take no more."""
    min_free_mb: Annotated[float, Meta(ge=0)] = 500.0
    """Recording stops before it leaves the disk less room."""

    memory_mb: Positive = 128.0
    """What may wait for the disk. Beyond it messages are dropped, large ones first, and counted."""
    flush_s: Annotated[float, Meta(gt=0, le=0.2)] = 0.1
    """The death of this process loses what came in this long, and a little more."""
    sync_s: Annotated[float, Meta(gt=0, le=0.8)] = 0.5
    """A loss of power loses what came in this long, and what the disk took to sync before."""


def folder_of(config: CaptureConfig) -> Path:
    if config.folder is not None:
        return Path(config.folder)
    if explicit := os.environ.get(FOLDER):
        return Path(explicit)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "cocoro" / "captures"
