"""Exports of captures as files for Foxglove."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from apps.cli.main import main

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


@pytest.fixture(scope="module")
def fox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")
    out = tmp_path_factory.mktemp("fox") / "fox.mcap"
    assert main(["export", str(GOLDEN), "--foxglove", str(out)]) == 0
    return out


def test_the_file_for_foxglove_has_its_schemas_in_the_robots_time(fox: Path) -> None:
    """tests/test_capture_foreign.py decodes and validates each message with npm packages."""
    from foxglove import messages as sdk

    shown: dict[str, list[bytes]] = {}
    recorded: dict[str, list[Any]] = {}
    last = 0
    with fox.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            assert last <= message.log_time < 10**10
            last = message.log_time
            if schema.name.startswith("foxglove."):
                assert schema.encoding == channel.message_encoding == "protobuf"
                assert schema.data == getattr(sdk, schema.name.removeprefix("foxglove.")).get_schema().data
                shown.setdefault(schema.name, []).append(message.data)
            else:
                assert channel.message_encoding == "json"
                recorded.setdefault(channel.topic, []).append(json.loads(message.data))
    assert {
        "foxglove.CompressedImage", "foxglove.CameraCalibration", "foxglove.PointCloud", "foxglove.FrameTransforms",
        "foxglove.SceneUpdate", "foxglove.ImageAnnotations", "foxglove.Log", "foxglove.Grid",
    } == set(shown)  # fmt: skip
    assert len(shown["foxglove.CompressedImage"]) == 60
    assert len(recorded["calliope/base/state"]) == 300
    transforms = b"".join(shown["foxglove.FrameTransforms"])
    assert all(frame in transforms for frame in (b"body", b"camera", b"gripper"))
    assert any(b"approach" in log for log in shown["foxglove.Log"])


def test_the_file_for_foxglove_is_no_larger_than_an_ordinary_capture(fox: Path) -> None:
    """Clouds of points come at 10 Hz at most, whatever the camera's rate is, and the chassis comes once."""
    stamps: dict[str, list[int]] = {}
    with fox.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            stamps.setdefault(channel.topic, []).append(message.log_time)
    clouds = stamps["/camera/points"]
    assert min(np.diff(clouds)) >= 10**8
    assert len(clouds) > 50
    assert len(stamps["/robot/chassis"]) == 1
    assert fox.stat().st_size < 1.2 * GOLDEN.stat().st_size  # its pictures are tiny, of 160 x 120 pixels


def test_without_foxglove_one_line_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    for module in ("apps.captures.export.foxglove", "apps.captures.export.foxglove_scene"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    assert main(["export", str(GOLDEN), "--foxglove", str(tmp_path / "fox.mcap")]) == 1
    assert "pip install 'cocoro-mesh[foxglove]'" in capsys.readouterr().err
    assert not (tmp_path / "fox.mcap").exists()
