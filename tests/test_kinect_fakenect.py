"""The Kinect's driver with libfreenect's playback library and recordings of the simulated Kinect."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import aclosing, closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from chessboard import Eyes, Painter, lying
from fakenect import player

from cocoro.clock import NS, RealClock
from cocoro.core import Sample
from cocoro.messages import Detections, ServoState
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from services.kinect import doctor, tools
from services.kinect.calibration import Board
from services.kinect.camera import FreenectCamera
from services.kinect.device import KinectConfig, RawFrame
from services.kinect.service import to_message
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from sim.service import SimConfig
from sim.wire.record import RATE_HZ, RecordingWriter, record

pytestmark = [pytest.mark.sim, pytest.mark.process]

FRAMES = 12
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> str:
    return player(tmp_path_factory.mktemp("fakenect"))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the paper's scene with a real sensor's errors: its noise makes each image unique."""
    folder = tmp_path_factory.mktemp("recordings") / "paper"
    record(folder, Robot.load(), SimConfig(sensors="real"), FRAMES, tilt_rad=-0.5)
    return folder


def copied(recording: Path, folder: Path) -> Path:
    """A copy that a test may damage."""
    copy = folder / "copy"
    copy.mkdir()
    for file in recording.iterdir():
        (copy / file.name).symlink_to(file)
    return copy


def damage(file: Path, left_bytes: int) -> bytes:
    """Truncate a file; returns its former contents."""
    whole = file.read_bytes()
    file.unlink()
    file.write_bytes(whole[:left_bytes])
    return whole


def pixels(recording: Path, kind: str) -> list[bytes]:
    """The pixels of a file of the recording: they follow the header line."""
    names = (recording / "INDEX.txt").read_text().splitlines()
    return [(recording / name).read_bytes().split(b"\n", 1)[1] for name in names if name.startswith(kind)]


@dataclass
class Played:
    shots: list[RawFrame] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    took_s: float = 0.0


def play(
    library: str, recording: Path, until: Callable[[Played], bool], on_fault: Callable[[], object] = int
) -> Played:
    """Take frames until the condition holds. Calls `on_fault` once, at the first real fault."""

    async def scenario() -> Played:
        played = Played()
        enough = asyncio.Event()
        loop = asyncio.get_running_loop()
        acts = [on_fault]

        def tell(fault: str) -> None:
            played.faults.append(fault)
            if fault and len(played.faults) > 1 and acts:
                acts.pop()()
            if until(played):
                enough.set()

        async def take() -> None:
            async with aclosing(camera.frames()) as shots:
                async for shot in shots:
                    played.shots.append(shot)
                    if until(played):
                        enough.set()

        config = KinectConfig(library=library, recording=str(recording))
        with closing(FreenectCamera(config, RealClock(), tell)) as camera:
            work = asyncio.create_task(take())
            began_s = loop.time()
            async with asyncio.timeout(PATIENCE_S):
                await enough.wait()
            played.took_s = loop.time() - began_s
            work.cancel()
            await asyncio.wait([work])
        return played

    return asyncio.run(scenario())


def number_of(shot: RawFrame, colours: list[bytes], depths: list[bytes]) -> int:
    """The number of the frame in the recording. Its colour and depth must be complete, and of the same moment."""
    number = colours.index(shot.colour.tobytes())
    assert shot.depth is not None
    assert shot.depth.astype("<u2").tobytes() == depths[number]
    return number


def test_every_pixel_is_right_each_pair_of_one_moment_and_the_pace_that_of_the_recording(
    library: str, recording: Path
) -> None:
    played = play(library, recording, lambda so_far: "the recording has ended" in so_far.faults)
    assert played.faults[0] == "the Kinect is being opened"
    colours, depths = pixels(recording, "r"), pixels(recording, "d")
    numbers = [number_of(shot, colours, depths) for shot in played.shots]
    # On a busy machine a frame may be missed, but none comes twice or out of order.
    assert numbers == sorted(set(numbers))
    assert len(numbers) > FRAMES // 2
    assert played.took_s >= (FRAMES - 1) / RATE_HZ
    stamps = np.array([shot.stamp_ns for shot in played.shots])
    paces_ms = np.diff(stamps) / np.diff(numbers) / 1e6
    assert np.median(paces_ms) == pytest.approx(1000 / RATE_HZ, rel=0.01)


def test_at_its_end_a_recording_is_played_again(library: str, recording: Path) -> None:
    played = play(library, recording, lambda so_far: so_far.faults.count("") == 2)
    assert played.faults == ["the Kinect is being opened", "", "the recording has ended", ""]


def test_a_damaged_recording_is_not_played_and_named_and_played_once_it_is_whole(
    library: str, recording: Path, tmp_path: Path
) -> None:
    copy = copied(recording, tmp_path)
    cut = sorted(copy.glob("d-*"))[3]
    whole = damage(cut, 5000)
    played = play(library, copy, lambda so_far: bool(so_far.shots), lambda: cut.write_bytes(whole))
    assert f"{cut} is damaged: its pixels take 4983 bytes, not 614400" in played.faults[1]
    assert played.faults[-1] == ""


def test_a_file_that_goes_missing_while_it_is_played_ends_the_library_and_not_the_service(
    library: str, recording: Path, tmp_path: Path
) -> None:
    copy = copied(recording, tmp_path)
    gone = sorted(copy.glob("r-*"))[-1]
    told: list[str] = []

    def until(so_far: Played) -> bool:
        if len(so_far.shots) == 1 and not told:
            gone.rename(copy / "elsewhere")
        told[:] = [fault for fault in so_far.faults if str(gone) in fault]
        return bool(told)

    played = play(library, copy, until)
    assert "the Kinect's library ended its process" in told[0] or "cannot be read" in told[0]
    assert played.shots


@pytest.mark.parametrize(("label", "pan_rad"), [("red_can", 0.0), ("blue_can", 0.8), ("green_can", -0.8)])
def test_perception_finds_the_recorded_objects_where_they_stand(
    label: str, pan_rad: float, library: str, tmp_path: Path
) -> None:
    robot, folder = Robot.load(), tmp_path / "recording"
    truth = record(folder, robot, SimConfig(sensors="real"), FRAMES, pan_rad=pan_rad, tilt_rad=-0.55)
    shots = play(library, folder, lambda so_far: len(so_far.shots) >= 5).shots
    core = PerceptionCore(robot, PerceptionConfig(), Catalogue.load())
    joints, angles = zip(*truth["head"].items(), strict=True)
    places = []
    for shot in shots:
        heads = [
            ServoState(stamp_ns=at_ns, joints=joints, position_rad=angles, speed_radps=(0.0, 0.0), load=(0.0, 0.0))
            for at_ns in (shot.stamp_ns - NS // 100, shot.stamp_ns + NS // 100)
        ]
        samples = [*(Sample(ARM_STATE, head) for head in heads), Sample(FRAME, to_message(shot))]
        for output in core.step(samples, shot.stamp_ns + NS // 50):
            if isinstance(output.message, Detections):
                places += [seen.position_m for seen in output.message.detections if seen.label == label]
    assert len(places) >= 5
    errors_m = np.linalg.norm(np.array(places, float) - truth["objects"][label], axis=1)
    assert errors_m.max() <= depth_step_m(robot, truth["objects"][label])


def test_views_of_a_chessboard_are_taken_from_the_device_and_kept(library: str, tmp_path: Path) -> None:
    board, robot = Board(8, 6, 0.04), Robot.load()
    lens = (robot.camera.fx, robot.camera.fy, robot.camera.cx, robot.camera.cy, 0.0, 0.0, 0.0, 0.0, 0.0)
    painter = Painter(Eyes(lens, lens, (0.0, 0.0, 0.0), robot.eye.depth_offset_m, robot.eye.curve), board)
    poses = [lying((0.2, 0.3 * side, 0.0), (0.1 * side, 0.0, 0.8), board) for side in (-1, 1)]
    pictures = [(painter.colour(*pose), painter.depth(*pose)) for pose in poses]
    with RecordingWriter(tmp_path / "recording") as writer:
        for number in range(40):
            writer.add(to_message(RawFrame(NS + number * NS // 30, *pictures[number // 20])))
    told: list[str] = []
    config = KinectConfig(library=library, recording=str(tmp_path / "recording"))
    views = tools.capture(config, board, 2, tmp_path / "views", told.append)
    assert [text for text in told if text.startswith("view")] == ["view 1 of 2", "view 2 of 2"]
    assert {view.depth.tobytes() for view in views} == {depth.tobytes() for _, depth in pictures}
    assert len(tools.read(tmp_path / "views", board, told.append)) == 2


def test_the_doctor_says_whether_pictures_come(library: str, recording: Path, tmp_path: Path) -> None:
    robot = Robot.load()
    sends, lenses = doctor.check(KinectConfig(library=library, recording=str(recording)), robot, "calliope")
    assert (sends.state, sends.text[:30]) == ("ok", "sends pictures, 640 x 480, dep")
    assert (lenses.state, lenses.text) == ("note", "not measured: `cocoro kinect calibrate`")
    nothing, _ = doctor.check(KinectConfig(library=library, recording=str(tmp_path)), robot, "calliope")
    assert nothing.state == "bad"
    assert "is not a recording" in nothing.text
    missing, _ = doctor.check(KinectConfig(library="/nowhere/libfreenect.so"), robot, "calliope")
    assert missing.text.endswith("sudo apt install libfreenect0.5")


def depth_step_m(robot: Robot, place_m: list[float]) -> float:
    """Depth step of one code at a place in the body frame, m: the camera is about 0.7 m above the floor."""
    away_m = float(np.linalg.norm(np.array(place_m) - [0.06, 0.0, 0.7]))
    a, b, _ = robot.eye.curve
    return a / b * (1.0 + (away_m / a) ** 2)
