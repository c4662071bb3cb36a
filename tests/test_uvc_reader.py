"""The driver of UVC cameras, against an emulation of `cv2.VideoCapture`."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cocoro.clock import NS, Clock, VirtualClock
from cocoro.errors import CocoroError
from cocoro.robot import Robot
from services.kinect import camera, uvc
from services.kinect.calibration import Board
from services.kinect.device import KinectConfig, OnFault, RawFrame
from services.kinect.doctor import check
from services.kinect.service import to_message
from services.kinect.tools import ViewCollector
from services.kinect.uvc import FROZEN_NS, UvcCamera, UvcReader, device_fault

CONFIG = KinectConfig(device="uvc", path="/dev/video9", width=64, height=48)
PERIOD_NS = NS // 30
READOUT_NS = 12_000_000
"""Between a buffer's stamp and its arrival."""


class Camera:
    """A camera on USB, and `cv2.VideoCapture` of it."""

    def __init__(self) -> None:
        self.now_ns = 5 * NS
        self.plugged, self.busy, self.frozen = True, False, False
        self.size = 64, 48
        self.buffer_ns: Callable[[int], int] = lambda at_ns: at_ns
        self.opened = 0
        self.pictures = 0
        self._stamp_ns = 0

    def open(self, config: KinectConfig) -> Camera:
        self.opened += 1
        return self

    def there(self, path: str) -> str:
        return "" if self.plugged else f"{path} is not there: is the camera plugged in?"

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return not self.busy

    def read(self) -> tuple[bool, NDArray[Any] | None]:
        self.now_ns += PERIOD_NS
        if not self.plugged:
            return False, None
        self.pictures += not self.frozen
        self._stamp_ns = self.buffer_ns(self.now_ns - READOUT_NS)
        picture = np.zeros((self.size[1], self.size[0], 3), dtype=np.uint8)
        picture[:] = (self.pictures % 200, 10, 250)  # BGR
        return True, picture

    def get(self, property_id: int, /) -> float:
        assert property_id == cv2.CAP_PROP_POS_MSEC
        return self._stamp_ns / 1e6

    def release(self) -> None:
        self.opened -= 1


@pytest.fixture
def device() -> Camera:
    return Camera()


@pytest.fixture
def reader(device: Camera) -> UvcReader:
    reader = UvcReader(CONFIG, device.open, lambda: device.now_ns, device.there)
    assert reader.step() == ("", 0, None)
    return reader


def test_a_picture_is_rgb_and_has_the_time_of_its_exposure(device: Camera, reader: UvcReader) -> None:
    taken = reader.step()
    assert taken.colour is not None
    assert taken.colour[3, 5].tolist() == [250, 10, 1]
    assert device.now_ns - taken.at_ns == pytest.approx(READOUT_NS + PERIOD_NS // 2, abs=1000)
    assert reader.by_driver


@pytest.mark.parametrize(
    "buffer_ns",
    [lambda at_ns: 0, lambda at_ns: at_ns + 1_700_000_000 * NS, lambda at_ns: at_ns - 2 * NS, lambda at_ns: -1],
    ids=["no stamp", "another clock", "too old", "refused"],
)
def test_a_stamp_that_is_no_time_of_this_clock_is_not_taken(
    device: Camera, reader: UvcReader, buffer_ns: Callable[[int], int]
) -> None:
    device.buffer_ns = buffer_ns
    assert device.now_ns + PERIOD_NS - reader.step().at_ns == round(CONFIG.least_age_s * NS)
    assert not reader.by_driver


def test_an_unplugged_camera_is_said_closed_and_opened_again(device: Camera, reader: UvcReader) -> None:
    assert reader.step().colour is not None
    device.plugged = False
    assert reader.step().fault == "the camera was unplugged: /dev/video9 is not there: is the camera plugged in?"
    assert device.opened == 0
    assert reader.step().fault == "/dev/video9 is not there: is the camera plugged in?"
    device.plugged = True
    assert reader.step().fault == ""
    assert reader.step().colour is not None
    assert device.opened == 1


def test_a_busy_device_is_said(device: Camera) -> None:
    device.busy = True
    reader = UvcReader(CONFIG, device.open, lambda: device.now_ns, device.there)
    assert reader.step().fault == "the camera /dev/video9 cannot be opened: does another program use it?"
    assert device.opened == 0
    device.busy = False
    assert reader.step().fault == reader.step().fault == ""


def test_pictures_of_another_size_are_a_fault(device: Camera, reader: UvcReader) -> None:
    device.size = 80, 60
    taken = reader.step()
    assert taken.fault.startswith("the camera /dev/video9 sends 80 x 60 pixels, not 64 x 48: set width and height")
    assert taken.colour is None


def test_a_frozen_picture_is_never_told_as_a_new_one(device: Camera, reader: UvcReader) -> None:
    assert reader.step().colour is not None
    device.frozen = True
    taken = [reader.step() for _ in range(FROZEN_NS // PERIOD_NS)]
    assert all(one == ("", 0, None) for one in taken)
    faults = [reader.step().fault for _ in range(2)]
    assert "does not change" in "".join(faults)
    device.frozen = False
    while reader.step().colour is None:
        pass
    assert device.opened == 1


class _Gated(Camera):
    """A camera whose next picture comes when the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = threading.Semaphore(0)

    def read(self) -> tuple[bool, NDArray[Any] | None]:
        self.gate.acquire()
        return super().read()


def test_what_the_device_sends_reaches_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the reader's thread: a picture, a fault, a picture again."""
    monkeypatch.setattr(uvc, "AGAIN_S", 0.0)
    device = _Gated()
    faults: list[str] = []

    async def scenario() -> list[RawFrame]:
        wrong = asyncio.Event()

        def on_fault(fault: str) -> None:
            faults.append(fault)
            if "80 x 60" in fault:
                wrong.set()

        config = KinectConfig(device="uvc", path="/dev/null", width=64, height=48)
        driver = UvcCamera(config, VirtualClock(), on_fault, device.open)
        frames = driver.frames()
        device.gate.release()
        first = await anext(frames)
        device.size = 80, 60
        device.gate.release()
        await wrong.wait()
        device.size = 64, 48
        device.gate.release()
        second = await anext(frames)
        driver.close()
        device.gate.release()
        return [first, second]

    first, second = asyncio.run(scenario())
    assert first.depth is second.depth is None
    assert (first.colour[0, 0].tolist(), second.colour.shape) == ([250, 10, 1], (48, 64, 3))
    assert faults[0] == "the camera is being opened"
    assert [fault for fault in faults if "hangs" not in fault][-3::2] == ["", ""]


def test_its_frames_are_those_of_every_camera_without_depth() -> None:
    message = to_message(RawFrame(7, np.full((4, 6, 3), 9, dtype=np.uint8), None))
    assert (message.width, message.height, message.stamp_ns, message.has_depth) == (6, 4, 7, False)
    assert message.colour[0] == 9


def test_a_missing_device_is_said_with_what_to_do() -> None:
    assert device_fault("/dev/no-camera") == "/dev/no-camera is not there: is the camera plugged in?"
    assert device_fault("/dev/null") == ""


class _One:
    """A driver that yields one frame."""

    def __init__(self, depth: bool) -> None:
        self._depth = np.full((4, 6), 800, dtype=np.uint16) if depth else None

    async def frames(self) -> Any:
        yield RawFrame(1, np.zeros((4, 6, 3), dtype=np.uint8), self._depth)

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("robot_name", "depth", "good"),
    [("lekiwi-colour", False, True), ("lekiwi-colour", True, False), ("lekiwi", False, False), ("lekiwi", True, True)],
)
def test_the_doctor_compares_the_device_with_the_description(
    monkeypatch: pytest.MonkeyPatch, robot_name: str, depth: bool, good: bool
) -> None:
    def open_one(config: KinectConfig, clock: Clock, on_fault: OnFault) -> _One:
        return _One(depth)

    monkeypatch.setattr(camera, "DRIVERS", {"uvc": open_one})
    looked, lens = check(CONFIG, Robot.load(Path(robot_name)), "kiwi")
    assert (looked.state == "ok") is good
    assert ("description has depth" in looked.text) is not good
    assert "not measured" in lens.text


def test_a_camera_without_depth_is_not_calibrated_as_a_kinect() -> None:
    with pytest.raises(CocoroError, match="no depth"):
        ViewCollector(Board(8, 6, 0.04)).take(RawFrame(0, np.zeros((4, 6, 3), dtype=np.uint8), None))
