"""Exports of captures for viewers, Foxglove and Rerun, and the geometry that they show."""

from __future__ import annotations

import json
import subprocess
import sys
import types
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_rig import ROBOT, Room, drive
from mcap.reader import make_reader

from apps.captures.export import rerun_scene
from apps.captures.export.geometry import Posture, about_z, conjugate, points, quaternion, rotated
from apps.captures.export.story import catalogue_of, robot_of
from apps.captures.reader import Capture
from apps.cli.export import watch
from apps.cli.main import main
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.kinematics import turn_z
from cocoro.messages import BaseCommand, Frame, ServoState
from cocoro.objects import Catalogue
from cocoro.vloop import run_virtual

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


# --- Foxglove -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")
    out = tmp_path_factory.mktemp("fox") / "fox.mcap"
    assert main(["export", str(GOLDEN), "--foxglove", str(out)]) == 0
    return out


def test_the_file_for_foxglove_has_its_schemas_in_the_robots_time(fox: Path) -> None:
    """tests/test_capture_foreign.py decodes and validates each message with npm packages."""
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
                shown.setdefault(schema.name, []).append(message.data)
            else:
                assert channel.message_encoding == "json"
                recorded.setdefault(channel.topic, []).append(json.loads(message.data))
    assert {
        "foxglove.CompressedImage", "foxglove.CameraCalibration", "foxglove.PointCloud", "foxglove.FrameTransforms",
        "foxglove.SceneUpdate", "foxglove.ImageAnnotations", "foxglove.Log",
    } == set(shown)  # fmt: skip
    assert len(shown["foxglove.CompressedImage"]) == len(shown["foxglove.PointCloud"]) == 60
    assert len(recorded["calliope/base/state"]) == 300
    transforms = b"".join(shown["foxglove.FrameTransforms"])
    assert all(frame in transforms for frame in (b"body", b"camera", b"gripper"))
    assert any(b"approach" in log for log in shown["foxglove.Log"])


def test_without_foxglove_one_line_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.delitem(sys.modules, "apps.captures.export.foxglove", raising=False)
    assert main(["export", str(GOLDEN), "--foxglove", str(tmp_path / "fox.mcap")]) == 1
    assert "pip install 'cocoro-mesh[foxglove]'" in capsys.readouterr().err
    assert not (tmp_path / "fox.mcap").exists()


# --- Rerun ----------------------------------------------------------------------------------------


class Made:
    """Stands in for any object of Rerun's, and keeps the arguments of its construction."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.args, self.options = args, options

    def __call__(self, *args: Any, **options: Any) -> Made:
        return Made(*args, **options)

    def __getattr__(self, name: str) -> Made:
        if name.startswith("__"):
            raise AttributeError(name)
        return Made()


class Stream:
    """A recording that keeps what is logged, by path."""

    newest: Stream

    def __init__(self, application: str) -> None:
        self.logged: dict[str, list[tuple[float, Any]]] = {}
        self.time_s = -1.0
        self.saved = ""
        Stream.newest = self

    def set_time(self, timeline: str, *, duration: float) -> None:
        assert timeline == rerun_scene.TIMELINE
        self.time_s = duration

    def log(self, path: str, what: Any, static: bool = False) -> None:
        assert " " not in path
        self.logged.setdefault(path, []).append((self.time_s, what))

    def save(self, path: str) -> None:
        self.saved = path

    def flush(self) -> None:
        pass


class FakeRerun(types.ModuleType):
    RecordingStream = Stream

    def __getattr__(self, name: str) -> Made:
        if name.startswith("__"):
            raise AttributeError(name)
        return Made()


def test_rerun_gets_pictures_points_poses_curves_and_phases(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    assert main(["export", str(GOLDEN), "--rrd", str(tmp_path / "out.rrd")]) == 0
    stream = Stream.newest
    logged = stream.logged
    assert stream.saved == str(tmp_path / "out.rrd")
    assert len(logged["world/body/camera/colour"]) == 60
    assert len(logged["world/body"]) == len(logged["curves/base/speed"]) == len(logged["curves/joints/elbow"]) == 300
    assert {"world/body/points", "world/body/links", "world/body/believed"} <= set(logged)
    assert len(logged["world/body/camera/colour/detections"]) == 60
    phases = [what.args[0] for _, what in logged["log"] if what.options["level"] == "INFO"]
    assert phases[0].startswith("fetch red_can: ")
    assert all(0.0 <= time_s < 10.0 for path, each in logged.items() if path != "world" for time_s, _ in each)


def test_rerun_gets_the_messages_of_a_live_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))

    async def look() -> None:
        room = Room()
        bus = room.mesh.join()
        watch(bus, "calliope", rerun_scene.RerunScene(Stream("cocoro"), ROBOT, Catalogue.load()))
        bus.publisher("calliope/base/state", Qos.STATE).put(b"no message")
        async with room.node("planning") as planning:
            await room.clock.sleep_until(10**9)
            planning.publish(topics.BASE_COMMAND, BaseCommand(left_mps=0.1, right_mps=0.2), stamp_ns=5)
            await drive(room, 1.0)

    run_virtual(look())
    logged = Stream.newest.logged
    assert len(logged["world/body"]) == 50
    assert len(logged["world/body/camera/colour"]) == 10
    (command,) = logged["curves/wheels/commanded_left"]  # however old it is
    assert command[1].args == (0.1,)


def test_without_rerun_one_line_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    for command in (["export", str(GOLDEN), "--rrd", str(tmp_path / "out.rrd")], ["view", str(GOLDEN)], ["view"]):
        assert main(command) == 1
        err = capsys.readouterr().err
        assert "pip install 'cocoro-mesh[view]'" in err
        assert len(err.splitlines()) == 1


def test_without_a_screen_one_line_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def spawn(_: Stream) -> None:
        raise RuntimeError("Failed to find Rerun Viewer executable in PATH")

    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    monkeypatch.setattr(Stream, "spawn", spawn, raising=False)
    monkeypatch.setenv("PATH", "")
    assert main(["view", str(GOLDEN)]) == 1
    err = capsys.readouterr().err
    assert "--rrd OUT.rrd" in err
    assert len(err.splitlines()) == 1


@pytest.mark.process
def test_rerun_itself_takes_it(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun is an extra, and not installed here")
    assert main(["export", str(GOLDEN), "--rrd", str(tmp_path / "out.rrd")]) == 0
    assert (tmp_path / "out.rrd").stat().st_size > 500_000
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "out.rrd")], check=True)


# --- geometry -------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, pi / 2, 3.0, -2.0])
def test_quaternions_turn_as_their_matrices_do(yaw_rad: float) -> None:
    yaw = turn_z(yaw_rad)[:3, :3]
    tilt = np.array([[1.0, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    for turn in (yaw, yaw @ tilt, tilt @ yaw):
        q = quaternion(turn)
        assert rotated(q, (1.0, 2.0, 3.0)) == pytest.approx(tuple(turn @ (1.0, 2.0, 3.0)))
        assert rotated(conjugate(q), rotated(q, (1.0, 2.0, 3.0))) == pytest.approx((1.0, 2.0, 3.0))
    assert rotated(about_z(yaw_rad), (1.0, 0.0, 0.0)) == pytest.approx((np.cos(yaw_rad), np.sin(yaw_rad), 0.0))


def test_points_stand_where_the_depth_says() -> None:
    depth = np.full((12, 16), 2047, dtype="<u2")
    depth[6, 8] = ROBOT.depth_code(np.array([1.5]))[0]
    colour = np.full((12, 16, 3), 7, dtype=np.uint8)
    frame = Frame(width=16, height=12, colour=memoryview(colour.tobytes()), depth=memoryview(depth.tobytes()))
    places, colours = points(frame, ROBOT, 1)
    ray = ROBOT.camera.scaled(16, 12).ray(8, 6) * 1.5 + np.array(ROBOT.kinect.depth_offset_m)
    assert places == pytest.approx(ray.reshape(1, 3), abs=0.01)
    assert colours.tolist() == [[7, 7, 7]]


def test_the_links_are_known_once_every_joint_is() -> None:
    posture = Posture(ROBOT)
    assert posture.links() == {}
    joints = tuple(ROBOT.joints)
    zero = (0.0,) * len(joints)
    posture.bend(ServoState(joints=joints, position_rad=zero, speed_radps=zero, load=zero))
    links = posture.links()
    assert links["camera"][:3, 3] == pytest.approx((0.0603, 0.0, 0.7331), abs=1e-3)
    assert len(posture.bones(links)) == len(links) == len(ROBOT.links)


def test_robot_and_objects_are_those_that_the_capture_has() -> None:
    with Capture.open(GOLDEN) as capture:
        assert "red_can" in catalogue_of(capture)
        assert robot_of(capture).kinect == ROBOT.kinect
