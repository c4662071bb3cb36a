"""Films of a simulated run from outside: where the camera stands, what the pictures show, and the files."""

from __future__ import annotations

from math import hypot
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from capture_rig import ROBOT, Room, drive, frame, record

from apps.captures.export import video
from apps.captures.export.geometry import about_z
from apps.captures.export.outside import CameraPath
from apps.cli.main import main
from cocoro import topics
from cocoro.arrays import FloatArray
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.errors import ConfigError
from cocoro.messages import TrueObject, Truth
from sim.outside import OutsideStage
from sim.render.outside import VIEW_RAD, OutsideRenderer, look_at
from sim.scene import Obstacle, Scene, load_scene
from sim.service import SimConfig
from sim.world import World

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
SIZE = 320, 180


def truth(x_m: float, y_m: float, yaw_rad: float = 0.0) -> Truth:
    can = TrueObject(label="red_can", kind="object", position_m=(1.5, 0.2, 0.06), orientation=(0, 0, 0, 1))
    joints = dict.fromkeys(ROBOT.joints, 0.0)
    return Truth(
        body_m=(x_m, y_m, 0.0), body_orientation=about_z(yaw_rad), joints_rad=joints, objects=(can,), stamp_ns=0
    )


def way(count: int = 150) -> list[Truth]:
    """A fetch of 5 s: 0.9 m ahead with a sudden start and end, then a turn in place."""
    places = np.clip(np.arange(count) / (0.6 * count) - 0.2, 0.0, 1.0) * 0.9
    turns = np.where(np.arange(count) > 0.9 * count, 1.5, 0.0)
    return [truth(float(x), 0.0, float(yaw)) for x, yaw in zip(places, turns, strict=True)]


def in_picture(pose: FloatArray, place: tuple[float, float, float]) -> tuple[float, float]:
    """Position of a point in a picture of 16 to 9, as shares of its half width and height from the middle."""
    x, y, z = pose[:3, :3].T @ (np.array(place) - pose[:3, 3])
    assert z > 0
    tangent = np.tan(VIEW_RAD / 2)
    return float(x / z / tangent * 9 / 16), float(y / z / tangent)


def path_of(scene: Scene, truths: list[Truth]) -> CameraPath:
    return CameraPath(scene, [n / 30 for n in range(len(truths))], truths, ["red_can"] * len(truths))


def test_the_camera_has_robot_and_target_in_every_picture_and_moves_smoothly() -> None:
    truths = way()
    path = path_of(load_scene("paper", 0), truths)
    poses = [path.pose(n) for n in range(len(truths))]
    for pose, there in zip(poses, truths, strict=True):
        x, y, _ = there.body_m
        for place in ((x, y, 0.0), (x, y, 0.75), (1.5, 0.2, 0.06)):
            assert max(map(abs, in_picture(pose, place))) < 0.95
    eyes = np.array([pose[:3, 3] for pose in poses])
    speeds = np.linalg.norm(np.diff(eyes, axis=0), axis=1) * 30
    assert speeds.max() < 1.0
    assert np.abs(np.diff(speeds)).max() * 30 < 1.5  # m/s^2


def test_the_camera_stands_where_no_obstacle_hides_the_robot() -> None:
    truths = [truth(0.0, 0.0)] * 60
    free = path_of(load_scene("paper", 0), truths)
    eye = free.pose(0)[:3, 3]
    wall = Obstacle(shape="box", size_m=(0.5, 0.5, 1.5), position_m=(0.6 * eye[0], 0.6 * eye[1]))
    other = path_of(Scene(name="walled", obstacles=(wall,)), truths).pose(0)[:3, 3]
    assert hypot(*(other - eye)[:2]) > 1.0


def test_far_targets_and_none_leave_the_robot_large() -> None:
    truths = [truth(-4.0, 0.0)] * 30
    path = path_of(load_scene("paper", 0), truths)
    low, high = (in_picture(path.pose(0), (-4.0, 0.0, height))[1] for height in (0.75, 0.0))
    assert high - low > 0.9


@pytest.mark.sim
@pytest.mark.parametrize("choice", ["auto", "tiny"])
def test_a_picture_from_outside_is_lit_and_shows_the_can(choice: Any) -> None:
    scene = load_scene("paper", 0)
    stage = OutsideStage(ROBOT, scene)
    with World(ROBOT, scene) as world:
        now = world.truth()
    (can,) = (np.array(item.position_m) for item in now.objects if item.label == "red_can")
    renderer = OutsideRenderer(stage.visuals, 160, 90, 8, choice)
    try:
        pose = look_at(can + np.array((0.5, -0.5, 0.4)), can)
        one, again = (renderer.picture(stage.poses(now), pose, can, (-0.4, 0.3, -1.0)) for _ in range(2))
    finally:
        renderer.close()
    np.testing.assert_array_equal(one, again)
    red, green, blue = one[45, 80].astype(int)
    assert red > 120 > 60 > max(green, blue)
    assert one[80, 10].min() > 100  # the floor


async def simulated(room: Room) -> None:
    """A simulator that states its scene and publishes the truth of a robot that drives, and what its camera sees."""
    with World(ROBOT, load_scene("paper", 0)) as world:
        first = world.truth()
    async with (
        room.node("sim", module="sim.service", config=SimConfig()) as sim,
        room.node("kinect") as kinect,
    ):
        sim.ready()
        kinect.ready()
        for tick in range(12):
            await room.clock.sleep_until(room.clock.now_ns() + 33_000_000)
            x, y, z = first.body_m
            sim.publish(topics.TRUTH, msgspec.structs.replace(first, body_m=(x + tick / 50, y, z)))
            if tick % 2 == 1:
                kinect.publish(topics.FRAME, frame(tick, 160, 120))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("film") / "run.mcap", simulated)


@pytest.mark.sim
def test_a_film_from_outside_and_one_with_the_robots_picture_in_a_corner(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "OUTSIDE_PX", SIZE)
    corners: list[Any] = []
    for camera in ("outside", "both"):
        out = tmp_path / f"{camera}.mp4"
        assert main(["export", str(run), "--video", str(out), "--camera", camera]) == 0
        film = cv2.VideoCapture(str(out))
        size = [film.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        assert size == list(SIZE)
        pictures = []
        while True:
            read, picture = film.read()
            if not read:
                break
            pictures.append(picture)
        assert len(pictures) == pytest.approx(12, abs=2)
        corners.append(pictures[-1][20:60, 240:300].astype(int))
    assert np.abs(corners[0] - corners[1]).mean() > 20


@pytest.mark.sim
def test_an_animation_shows_its_pictures_at_their_times(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "ANIMATION_PX", SIZE)
    monkeypatch.setattr("sim.render.outside.FINE", 4)
    out = tmp_path / "run.webp"
    assert main(["export", str(run), "--video", str(out), "--camera", "outside"]) == 0
    read, animation = cv2.imreadanimation(str(out))
    assert read
    assert len(animation.frames) == 4
    assert list(animation.durations)[:3] == [99, 99, 99]
    assert animation.frames[0].shape[:2] == SIZE[::-1]


def test_what_cannot_be_filmed_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def blind(room: Room) -> None:
        await drive(room, 0.2)

    real = record(tmp_path / "real.mcap", blind)
    out = tmp_path / "film.mp4"
    for path, camera, code, words in (
        (GOLDEN, "outside", 1, "sim/truth"),
        (real, "both", 1, "no capture of a simulated robot"),
        (GOLDEN, "inside", 2, "known are robot, outside, both"),
    ):
        assert main(["export", str(path), "--video", str(out), "--camera", camera]) == code
        err = capsys.readouterr().err
        assert words in err
        assert len(err.splitlines()) == 1
        assert not out.exists()
    with pytest.raises(CaptureError, match="60 s at most"):
        video.check(tmp_path / "long.webp", 61.0)
    with pytest.raises(ConfigError):
        video.camera_of("")


@pytest.mark.process
@pytest.mark.sim
def test_a_rehearsal_is_filmed_and_leaves_the_film_alone(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(video, "OUTSIDE_PX", SIZE)

    def rehearse(request: Any, _tell: Any = None) -> dict[str, Any]:
        Path(request.record).write_bytes(run.read_bytes())
        return {"task": "park", "label": "", "outcome": "done", "sim_s": 1.0, "wall_s": 1.0, "phases": [], "truth": {}}

    monkeypatch.setattr("apps.rehearsal.rehearse.rehearse", rehearse)
    out = tmp_path / "films" / "park.mp4"
    assert main(["rehearse", "park", "--video", str(out)]) == 0
    assert "pictures" in capsys.readouterr().out
    assert [path.name for path in out.parent.iterdir()] == ["park.mp4"]
    assert main(["rehearse", "park", "--video", str(out)]) == 1
    assert "exists; remove it" in capsys.readouterr().err
    assert main(["rehearse", "park", "--video", str(tmp_path / "b.mp4"), "--record", str(tmp_path / "b.mcap")]) == 0
    with Capture.open(tmp_path / "b.mcap") as capture:
        assert capture.robot == "calliope"
