"""Recordings for libfreenect's playback library have the format of its README."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cocoro.errors import ConfigError
from cocoro.messages import Frame
from sim.wire.record import RecordingWriter

COLOUR = np.arange(480 * 640 * 3, dtype=np.uint32).astype(np.uint8)
DEPTH = (np.arange(480 * 640) % 2048).astype("<u2")


def frame(stamp_ns: int, width: int = 640, height: int = 480) -> Frame:
    pixels = width * height
    return Frame(
        stamp_ns=stamp_ns,
        width=width,
        height=height,
        colour=COLOUR[: 3 * pixels].data,
        depth=DEPTH[:pixels].view(np.uint8).data,
    )


def test_each_observation_is_a_file_named_by_kind_time_and_ticks(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "new" / "folder") as writer:
        writer.add(frame(1_500_000_000))
        writer.add(frame(80_000_033_333), at_ns=80_000_033_000)
    names = (writer.folder / "INDEX.txt").read_text().splitlines()
    wrapped = 80_000_033_000 * 60 // 1000 % (1 << 32)
    assert names == [
        "a-1.500000-90000000.dump",
        "d-1.500000-90000000.pgm",
        "r-1.500000-90000000.ppm",
        f"d-80.000033-{wrapped}.pgm",
        f"r-80.000033-{wrapped}.ppm",
    ]
    header, pixels = (writer.folder / names[1]).read_bytes().split(b"\n", 1)
    assert (header, pixels) == (b"P5 640 480 65535", DEPTH.tobytes())
    header, pixels = (writer.folder / names[2]).read_bytes().split(b"\n", 1)
    assert (header, pixels) == (b"P6 640 480 255", COLOUR.tobytes())
    x, y, z, angle, status = struct.unpack("<hhhbxi", (writer.folder / names[0]).read_bytes())
    assert (x, y, z, angle, status) == (0, 819, 0, 0, 0)  # 1 g upward: it stands level


def test_pictures_of_another_size_are_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path) as writer, pytest.raises(ConfigError, match="are 640 x 480, not 320 x 240"):
        writer.add(frame(0, 320, 240))


@pytest.mark.process
def test_a_folder_that_holds_a_recording_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "INDEX.txt").write_text("precious\n")
    with pytest.raises(ConfigError, match="holds a recording already"):
        RecordingWriter(tmp_path)
    command = [sys.executable, "-m", "sim.wire.record", str(tmp_path), "--seconds", "0.1"]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(f"{tmp_path} ")
    assert "recording already" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert (tmp_path / "INDEX.txt").read_text() == "precious\n"
