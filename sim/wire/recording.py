"""A recording that libfreenect's playback library, fakenect, plays in the place of a Kinect.

Written from its README: a folder with a file for each observation, named TYPE-SECONDS-TICKS, where TYPE is r for
colour, d for depth, a for acceleration; SECONDS is when it arrived, by which it is paced, TICKS what the device's own
clock said. Colour is a PPM and depth a PGM, both with their header on one line; the 16 bits of a depth are
little-endian, as the device's own buffer has them, whatever PGM says. Acceleration is the bytes of libfreenect's
freenect_raw_tilt_state. INDEX.txt holds the names, one a line, in the order in which they are played.
"""

from __future__ import annotations

import struct
from pathlib import Path
from types import TracebackType
from typing import TextIO

from cocoro.clock import NS
from cocoro.errors import ConfigError
from cocoro.messages import Frame

WIDTH, HEIGHT = 640, 480
TICKS_HZ = 60_000_000
COUNTS_PER_G = 819
LEVEL = struct.pack("<hhhbxi", 0, COUNTS_PER_G, 0, 0, 0)
"""freenect_raw_tilt_state of a Kinect that stands level: x, y, z, tilt angle, tilt status."""


class RecordingWriter:
    """Use it as a context manager. Raises ConfigError where there is a recording already, or no place for one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.frames = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._index: TextIO = (folder / "INDEX.txt").open("x", encoding="ascii")
        except FileExistsError:
            raise ConfigError(f"{folder} holds a recording already: name another folder") from None
        except OSError as error:
            raise ConfigError(f"{folder} cannot be written: {error.strerror}") from error

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._index.close()

    def add(self, frame: Frame, at_ns: int | None = None) -> None:
        """Write a frame. It was taken at `at_ns`, ns, by whatever clock; at its stamp where nothing is said."""
        if (frame.width, frame.height) != (WIDTH, HEIGHT):
            raise ConfigError(f"a Kinect's pictures are {WIDTH} x {HEIGHT}, not {frame.width} x {frame.height}")
        at_ns = frame.stamp_ns if at_ns is None else at_ns
        if self.frames == 0:
            self._write("a", at_ns, LEVEL, "dump")
        self._write("d", at_ns, b"P5 %d %d 65535\n" % (WIDTH, HEIGHT) + frame.depth, "pgm")
        self._write("r", at_ns, b"P6 %d %d 255\n" % (WIDTH, HEIGHT) + frame.colour, "ppm")
        self.frames += 1

    def _write(self, kind: str, at_ns: int, data: bytes, ending: str) -> None:
        ticks = at_ns * TICKS_HZ // NS % (1 << 32)
        name = f"{kind}-{at_ns // NS}.{at_ns % NS // 1000:06d}-{ticks}.{ending}"
        (self.folder / name).write_bytes(data)
        self._index.write(f"{name}\n")
