"""Captures are read by libraries that know nothing of this project, as docs/captures.md describes."""

from __future__ import annotations

import json
import shutil
import subprocess
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader

from cocoro.capture.reader import Capture

HERE = Path(__file__).parent
GOLDEN = HERE / "golden" / "fetch.mcap"
UNREACHABLE = ("ENOTFOUND", "ECONNREFUSED", "ETIMEDOUT", "EAI_AGAIN", "ENETUNREACH", "ECONNRESET", "ENOTCACHED")


@pytest.fixture(scope="module")
def expected() -> dict[str, tuple[str, int]]:
    """Each key's type and number of messages, by this project's reader."""
    with Capture.open(GOLDEN) as capture:
        counts = Counter(record.key for record in capture.messages())
        schemas = {key: capture.schema(channel) for key, (channel,) in capture.keys.items()}
        return {key: (schema.name if schema else "", counts[key]) for key, schema in schemas.items()}


def test_the_mcap_and_msgpack_libraries_read_everything_by_the_page(expected: dict[str, tuple[str, int]]) -> None:
    found: Counter[tuple[str, str]] = Counter()
    with GOLDEN.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "cocoro"
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "msgpack")
            value = msgpack.unpackb(message.data)
            assert set(value) <= set(json.loads(schema.data)["properties"])
            assert message.publish_time == (value["stamp_ns"] or message.log_time)
            assert message.sequence == value["seq"]
            found[channel.topic, schema.name] += 1
            if channel.topic == "calliope/kinect/frame":
                colour = np.frombuffer(value["colour"], np.uint8).reshape(value["height"], value["width"], 3)
                depth = np.frombuffer(value["depth"], "<u2").reshape(value["height"], value["width"])
                assert colour.mean() > 10
                assert depth.max() <= 2047
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert {key: (name, count) for (key, name), count in found.items()} == expected
    assert json.loads(metadata["robot"]["description"])["kinect"]["depth_curve"] == [0.1236, 2842.5, 1.1863]
    assert json.loads(metadata["tally"]["dropped"]) == {}
    for entries in metadata.values():
        assert entries["crc32"] == _crc(entries)


def _crc(entries: dict[str, str]) -> str:
    """The checksum of metadata, as docs/captures.md defines it."""
    crc = 0
    for name in sorted(entries):
        if name != "crc32":
            crc = zlib.crc32(name.encode() + b"\0" + entries[name].encode() + b"\0", crc)
    return f"{crc:08x}"


# --- node -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tests/foreign with its npm packages, at the versions of the lock file."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not installed: the npm packages cannot read the capture here")
    folder = tmp_path_factory.mktemp("foreign")
    for name in ("package.json", "package-lock.json", "read.mjs", "foxglove.mjs"):
        shutil.copy(HERE / "foreign" / name, folder)
    command = ["npm", "ci", "--no-audit", "--no-fund", "--prefer-offline", "--ignore-scripts"]
    command += ["--fetch-retries=0", "--fetch-timeout=20000"]  # by itself it tries for more than a minute
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    if done.returncode:
        if any(word in done.stderr for word in UNREACHABLE):
            pytest.skip("npm cannot reach its registry, and has the packages not in its cache")
        pytest.fail(f"npm ci: {done.stderr}")
    return folder


def _read(reader: Path, capture: Path, how: str) -> dict[str, Any]:
    return _run(reader, "read.mjs", str(capture), how)


def _run(reader: Path, *words: str) -> dict[str, Any]:
    done = subprocess.run(["node", *words], cwd=reader, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.process
@pytest.mark.parametrize("how", ["indexed", "stream"])
def test_the_npm_packages_read_everything_by_the_page(
    how: str, reader: Path, expected: dict[str, tuple[str, int]]
) -> None:
    found = _read(reader, GOLDEN, how)
    assert found["problem"] == ""
    assert {key: (told["type"], told["messages"]) for key, told in found["keys"].items()} == expected
    assert all(told["encoding"] == "msgpack" and told["unknown"] == [] for told in found["keys"].values())
    assert "description" in found["metadata"]["robot"]
    with Capture.open(GOLDEN) as capture:
        states = list(capture.messages("base/state"))
        frames = [capture.decode(record) for record in capture.messages("kinect/frame")]
    assert found["keys"]["calliope/base/state"]["stamps"] == [str(record.publish_ns) for record in states]
    middles = [np.frombuffer(frame["depth"], "<u2").reshape(120, 160)[60, 80] for frame in frames]
    assert found["frames"] == [[160, 120, 160 * 120 * 3, int(middle)] for middle in middles]


@pytest.mark.process
def test_the_npm_packages_read_what_a_killed_recorder_left(reader: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed.mcap"
    killed.write_bytes(GOLDEN.read_bytes()[: GOLDEN.stat().st_size // 2])
    found = _read(reader, killed, "stream")
    with Capture.open(killed) as capture:
        counts = Counter(record.key for record in capture.messages())
    assert {key: told["messages"] for key, told in found["keys"].items()} == counts
    assert sum(counts.values()) > 1000


@pytest.mark.process
def test_what_is_exported_for_foxglove_is_by_foxgloves_own_schemas(reader: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")
    from apps.captures.export import foxglove

    with Capture.open(GOLDEN) as capture:
        foxglove.export(capture, tmp_path / "fox.mcap")
        frames = sum(1 for _ in capture.messages("kinect/frame"))
    found = _run(reader, "foxglove.mjs", str(tmp_path / "fox.mcap"))
    assert {name: told["problem"] for name, told in found.items() if told["problem"]} == {}
    assert found["foxglove.CompressedImage"]["messages"] == frames
    assert found["foxglove.PointCloud"]["messages"] > 50
    assert {"foxglove.CameraCalibration", "foxglove.FrameTransforms", "foxglove.SceneUpdate"} <= found.keys()
    assert {"foxglove.ImageAnnotations", "foxglove.Log"} <= found.keys()
