"""Exports of captures: film, tables, Foxglove, Rerun."""

from __future__ import annotations

import csv
import json
import resource
import subprocess
import sys
import types
from math import pi
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from capture_rig import ROBOT, Room, drive, record
from mcap.reader import make_reader

from apps.captures.export import rerun_scene, tables, video
from apps.captures.export.geometry import Posture, about_z, conjugate, points, quaternion, rotated
from apps.captures.export.story import catalogue_of, robot_of
from apps.captures.reader import Capture
from apps.cli.export import watch
from apps.cli.main import main
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.capture.conventions import CaptureError
from cocoro.kinematics import turn_z
from cocoro.messages import BaseCommand, Frame, PlannerStatus, ServoState, TargetEstimate, TrueObject, Truth
from cocoro.objects import Catalogue
from cocoro.vloop import run_virtual

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden capture in the forms that need no extra."""
    folder = tmp_path_factory.mktemp("exported")
    forms = {"--video": "film.mp4", "--csv": "csv"}
    assert (
        main(["export", str(GOLDEN), *(word for form, name in forms.items() for word in (form, str(folder / name)))])
        == 0
    )
    return folder


# --- the film -------------------------------------------------------------------------------------


def test_the_film_lasts_as_long_as_the_capture_and_shows_what_the_robot_saw(exported: Path) -> None:
    film = cv2.VideoCapture(str(exported / "film.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == video.RATE_HZ
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (160, 120)
    pictures = []
    while (read := film.read())[0]:
        pictures.append(read[1])
    with Capture.open(GOLDEN) as capture:
        frames = [capture.read(each) for each in capture.messages("kinect/frame")]
        lasts_s = (capture.end_ns - capture.start_ns) / 1e9
    assert len(pictures) / video.RATE_HZ == pytest.approx(lasts_s, abs=0.2)
    last = frames[-1]
    assert isinstance(last, Frame)
    seen = np.frombuffer(last.colour, np.uint8).reshape(120, 160, 3)[:90, :, ::-1]
    difference = np.abs(pictures[-1][:90].astype(int) - seen.astype(int))
    assert np.median(difference) < 12  # except for what is drawn in, and the film's compression


def test_a_capture_without_pictures_makes_no_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def blind(room: Room) -> None:
        await drive(room, 0.5, frames=False)

    path = record(tmp_path / "blind.mcap", blind)
    assert main(["export", str(path), "--video", str(tmp_path / "film.mp4")]) == 1
    assert "it has no pictures" in capsys.readouterr().err
    assert main(["export", str(path)]) == 2


def test_a_film_that_the_disk_did_not_take_whole_is_no_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        assert main(["export", str(GOLDEN), "--video", str(tmp_path / "film.mp4")]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "could not be written to its end" in capsys.readouterr().err
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize(
    ("form", "name", "words"),
    [
        ("--video", "film.avi", "name ends with .mp4"),
        ("--video", "file/in/film.mp4", "film.mp4: Not a directory"),
        ("--foxglove", "file/in/fox.mcap", "fox.mcap: Not a directory"),
        ("--csv", "file", "arm_alive.csv: "),
    ],
)
def test_a_place_where_nothing_can_be_written_is_told_in_one_line(
    form: str, name: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if form == "--foxglove":
        pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")
    (tmp_path / "file").write_text("no folder")
    assert main(["export", str(GOLDEN), form, str(tmp_path / name)]) == 1
    err = capsys.readouterr().err
    assert words in err
    assert len(err.splitlines()) == 1


# --- tables ---------------------------------------------------------------------------------------


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_each_key_is_a_table_with_a_column_for_each_number(exported: Path) -> None:
    states = _rows(exported / "csv" / "base_state.csv")
    with Capture.open(GOLDEN) as capture:
        records = list(capture.messages("base/state"))
        recorded = [capture.decode(each) for each in records]
        joints = capture.decode(next(capture.messages("arm/state")))["joints"]
    assert [float(row["odometry_m.0"]) for row in states] == [state["odometry_m"][0] for state in recorded]
    assert [int(row["stamp_ns"]) for row in states] == [each.publish_ns for each in records]
    assert _rows(exported / "csv" / "kinect_frame.csv")[0]["colour.bytes"] == str(160 * 120 * 3)
    assert _rows(exported / "csv" / "arm_state.csv")[0]["joints.0"] == joints[0]


def test_what_is_nothing_now_and_then_has_the_columns_of_its_parts_alone(exported: Path) -> None:
    plans = _rows(exported / "csv" / "planning_status.csv")
    assert {"target.label", "target.position_m.0", "hand_m.2", "distance_m"} <= set(plans[0])
    assert not {"target", "hand_m"} & set(plans[0])
    assert {row["target.label"] for row in plans} == {"", "red_can"}


def test_a_list_of_maps_is_a_table_of_its_own(exported: Path) -> None:
    seen = _rows(exported / "csv" / "perception_detections.detections.csv")
    assert {"label", "u_px", "position_m.2", "index", "seq"} <= set(seen[0])
    with Capture.open(GOLDEN) as capture:
        count = sum(len(capture.decode(each)["detections"]) for each in capture.messages("perception/detections"))
    assert len(seen) == count


def test_belief_stands_beside_truth_in_the_body_frame(tmp_path: Path) -> None:
    async def drive_past(room: Room) -> None:
        """The body faces left, along y, and moves 0.1 m between two truths; the can is 1 m to its right."""
        async with room.node("sim") as sim, room.node("planning") as planning:
            can = TrueObject(label="red_can", kind="object", position_m=(2.0, 1.0, 0.06), orientation=(0, 0, 0, 1))
            for tick in range(11):
                place, turn = (1.0, tick / 10, 0.0), about_z(pi / 2)
                truth = Truth(body_m=place, body_orientation=turn, joints_rad={}, objects=(can,))
                sim.publish(topics.TRUTH, truth)
                if tick == 5:
                    await room.clock.sleep_until(room.clock.now_ns() + 10_000_000)
                    believed = TargetEstimate(label="red_can", position_m=(0.5, -1.0, 0.06))
                    planning.publish(topics.PLAN, PlannerStatus(known=(believed,)))
                await room.clock.sleep_until(room.clock.now_ns() + 20_000_000)

    path = record(tmp_path / "truth.mcap", drive_past)
    with Capture.open(path) as capture:
        assert "belief" in tables.export(capture, tables.CsvFolder(tmp_path / "csv"))
    (row,) = _rows(tmp_path / "csv" / "belief.csv")
    gone_m = 0.5 + 0.1 / 3  # 10 of the 30 ms between the truths have passed
    assert (float(row["true_x_m"]), float(row["true_y_m"])) == pytest.approx((1.0 - gone_m, -1.0), abs=1e-6)
    assert float(row["error_m"]) == pytest.approx(0.1 / 3, abs=1e-6)


def test_parquet_needs_pyarrow_or_says_how_to_get_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["export", str(GOLDEN), "--parquet", str(tmp_path / "tables")])
    try:
        import pyarrow.parquet
    except ModuleNotFoundError:
        assert code == 1
        assert "pip install 'cocoro-mesh[tables]'" in capsys.readouterr().err
        return
    assert code == 0
    assert pyarrow.parquet.read_table(tmp_path / "tables" / "base_state.parquet").num_rows == 300


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


def test_an_export_does_not_write_over_a_file(exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file might be the capture."""
    with Capture.open(GOLDEN) as capture, pytest.raises(CaptureError, match="exists; remove it"):
        video.export(capture, exported / "film.mp4")
    for form in ("--video", "--foxglove", "--rrd"):
        assert main(["export", str(GOLDEN), form, str(exported / "film.mp4")]) == 1
        assert "exists; remove it" in capsys.readouterr().err
    before = GOLDEN.read_bytes()
    assert main(["export", str(GOLDEN), "--csv", str(exported / "more"), "--rrd", str(GOLDEN)]) == 1
    assert "exists; remove it" in capsys.readouterr().err
    assert GOLDEN.read_bytes() == before
    assert not (exported / "more").exists()  # all outputs are checked before the first is made


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
        self.told: dict[str, list[tuple[float, Any]]] = {}
        self.time_s = -1.0
        self.saved = ""
        Stream.newest = self

    def set_time(self, timeline: str, *, duration: float) -> None:
        assert timeline == rerun_scene.TIMELINE
        self.time_s = duration

    def log(self, path: str, what: Any, static: bool = False) -> None:
        assert " " not in path
        self.told.setdefault(path, []).append((self.time_s, what))

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


def test_rerun_is_told_of_pictures_points_poses_curves_and_phases(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    assert main(["export", str(GOLDEN), "--rrd", str(tmp_path / "out.rrd")]) == 0
    stream = Stream.newest
    told = stream.told
    assert stream.saved == str(tmp_path / "out.rrd")
    assert len(told["world/body/camera/colour"]) == 60
    assert len(told["world/body"]) == len(told["curves/base/speed"]) == len(told["curves/joints/elbow"]) == 300
    assert {"world/body/points", "world/body/links", "world/body/believed"} <= set(told)
    assert len(told["world/body/camera/colour/detections"]) == 60
    phases = [what.args[0] for _, what in told["log"] if what.options["level"] == "INFO"]
    assert phases[0].startswith("fetch red_can: ")
    assert all(0.0 <= time_s < 10.0 for path, each in told.items() if path != "world" for time_s, _ in each)


def test_rerun_is_told_of_the_mesh_as_it_goes(monkeypatch: pytest.MonkeyPatch) -> None:
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
    told = Stream.newest.told
    assert len(told["world/body"]) == 50
    assert len(told["world/body/camera/colour"]) == 10
    (command,) = told["curves/wheels/commanded_left"]  # however old it is
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


def test_robot_and_objects_are_those_that_the_capture_tells_of() -> None:
    with Capture.open(GOLDEN) as capture:
        assert "red_can" in catalogue_of(capture)
        assert robot_of(capture).kinect == ROBOT.kinect
