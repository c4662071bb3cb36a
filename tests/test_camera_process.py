"""The camera in a process of its own: the same frames, delivered when they are due, and a clear end."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from pictures import CAMERA, ROBOT, Lamp
from robot_rig import RobotRig

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro import topics
from cocoro.errors import CocoroError
from cocoro.messages import Frame
from cocoro.vloop import run_virtual
from sim.camera import SimKinect
from sim.camera_process import start
from sim.camera_process.remote import RemoteKinect
from sim.render import make_renderer
from sim.render.interface import Visual
from sim.service import FRAME_LATENCY_S

CAN = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
SIZE = {"width": CAMERA.width, "height": CAMERA.height}
FRAME_NS = 33_333_333
LAMP = Lamp()


def exposures() -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
    """Poses of the can, pose of the camera that turns, and stamp, of three frames."""
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = [1.2, 0.0, 0.06]
    for number in range(3):
        angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": -0.45, "neck_pan": 0.03 * number}
        yield poses, ROBOT.chain("camera").pose(angles), number * FRAME_NS


def digest(frame: Frame) -> str:
    return hashlib.sha256(bytes(frame.colour) + bytes(frame.depth)).hexdigest() + f" {frame.stamp_ns}"


def film_here() -> list[str]:
    with SimKinect(ROBOT, make_renderer([CAN], CAMERA), sensors="real", seed=3, **SIZE) as camera:
        return [digest(camera.capture(*exposure, LAMP)) for exposure in exposures()]


@contextmanager
def remote(slots: int = 3) -> Iterator[RemoteKinect]:
    with RemoteKinect(ROBOT, [CAN], sensors="real", seed=3, renderer="auto", slots=slots, **SIZE) as camera:
        yield camera


def film_there() -> list[str]:
    """All frames are exposed before the first one is delivered."""
    with remote() as camera:
        due = [camera.expose(*exposure, LAMP) for exposure in exposures()]
        return [digest(frame()) for frame in due]


@pytest.mark.process
@pytest.mark.sim
def test_another_process_takes_the_same_frames() -> None:
    assert film_there() == film_here()


@pytest.mark.process
@pytest.mark.sim
def test_a_process_with_one_thread_forks_its_camera_and_gets_the_same_frames() -> None:
    program = f"""
import os, sys
os.environ["OPENBLAS_NUM_THREADS"] = "1"
sys.path.insert(0, {__file__.rpartition("/")[0]!r})
import cv2
from sim.camera_process import start
assert start._alone()
with start.started_ahead():
    import test_camera_process as t
    print(*t.film_there(), sep="\\n")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=100)
    assert done.stdout.splitlines() == film_here()


@pytest.mark.process
@pytest.mark.sim
def test_a_camera_whose_process_was_killed_says_so() -> None:
    with remote() as camera:
        exposure = next(exposures())
        camera.expose(*exposure, LAMP)()
        camera._started._process.kill()
        with pytest.raises(CocoroError, match=r"camera's process has ended \(exit code -9\)"):
            camera.expose(*exposure, LAMP)()


@pytest.mark.process
def test_a_process_that_was_started_ahead_in_vain_ends_with_the_command() -> None:
    with start.started_ahead():
        (started,) = start._ahead
    assert not start._ahead
    assert started.end() == -9


@pytest.mark.process
@pytest.mark.sim
def test_a_rehearsal_has_the_same_result_with_its_camera_in_a_process_of_its_own() -> None:
    def result(camera_process: bool) -> dict[str, object]:
        request = RehearsalRequest(
            task={"task": "park"}, width=160, height=120, frame_rate_hz=15.0, sensors="real", wait_s=0.5, trace=True,
            camera_process=camera_process,
        )  # fmt: skip
        return rehearse(request) | {"wall_s": 0.0}

    assert result(True) == result(False)


@pytest.mark.sim
@pytest.mark.parametrize("sensors", ["ideal", "real"])
def test_frames_are_delivered_in_order_and_one_read_out_after_their_exposure(sensors: str) -> None:
    ages_s: list[float] = []
    stamps_ns: list[int] = []

    async def scenario() -> None:
        settings = {"sim": {"width": 64, "height": 48, "frame_rate_hz": 60.0, "sensors": sensors}}
        async with RobotRig(services=("sim",), settings=settings) as rig:

            def keep(frame: Frame) -> None:
                ages_s.append((rig.operator.now_ns() - frame.stamp_ns) / 1e9)
                stamps_ns.append(frame.stamp_ns)

            rig.operator.on(topics.FRAME, keep)
            await rig.advance(0.5)

    run_virtual(scenario())
    assert len(stamps_ns) > 20
    assert stamps_ns == sorted(stamps_ns)
    assert min(ages_s) >= FRAME_LATENCY_S
    assert max(ages_s) <= FRAME_LATENCY_S + 1 / 120 + 1e-6  # the simulator publishes at its ticks


@pytest.mark.process
def test_the_command_of_a_rehearsal_imports_no_numpy_before_it_has_set_its_threads() -> None:
    """With NumPy's threads it could not fork the camera's process."""
    program = "import sys, apps.cli.rehearse; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=100).returncode == 0
