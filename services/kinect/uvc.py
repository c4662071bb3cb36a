"""Colour cameras on USB (UVC), by OpenCV and Video4Linux: pictures without depth.

`UvcReader` has the device and does one thing at a time, in a thread; `UvcCamera` brings what it reads to the event
loop. A picture's stamp is that of the kernel's buffer, which its driver takes on CLOCK_MONOTONIC as the picture begins
to arrive. Where a driver gives none, or one of another clock, it is the time of arrival.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import ImageArray
from cocoro.clock import NS, Clock
from services.kinect.device import KinectConfig, OnFault, RawFrame
from services.kinect.freenect import LED

AGAIN_S = 1.0
"""Time between two attempts to open the device."""
SILENT_S = 3.0
"""Without news from the reader for this long, the device hangs. OpenCV itself gives up after ten seconds."""
FROZEN_NS = NS // 2
"""A picture that is equal to the one before in every byte is none: a sensor has noise. So long without another one is a
fault."""
OLDEST_NS = NS
"""A buffer's stamp that is older at its arrival, or of the future, is of another clock."""
OPENING = "the camera is being opened"


class Video(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool: ...  # noqa: N802 - OpenCV's name

    def read(self) -> tuple[bool, NDArray[Any] | None]:
        """Wait for the next picture: whether there is one, and it, BGR, (height, width, 3)."""

    def get(self, property_id: int, /) -> float: ...

    def release(self) -> None: ...


OpenVideo = Callable[[KinectConfig], Video]


class Taken(NamedTuple):
    """What one step of the reader brought: a picture, a fault, or neither."""

    fault: str = ""
    at_ns: int = 0
    """CLOCK_MONOTONIC: of the middle of the exposure."""
    colour: ImageArray | None = None
    """RGB, (height, width, 3)."""


class UvcReader:
    """Opens the device, reads it, and opens it again after a fault. Its methods are called by one thread."""

    def __init__(
        self,
        config: KinectConfig,
        open_video: OpenVideo,
        now_ns: Callable[[], int] = time.monotonic_ns,
        there: Callable[[str], str] | None = None,
    ) -> None:
        """`there`: '' for a device that this user may open, else what is wrong with it, a sentence."""
        self._config = config
        self._open_video = open_video
        self._now_ns = now_ns
        self._there = device_fault if there is None else there
        self._video: Video | None = None
        self._before: NDArray[Any] | None = None
        self._changed_ns = 0
        self.by_driver = False
        """Whether the newest picture's stamp is that of the kernel's buffer."""

    def step(self) -> Taken:
        """Open the device, or read one picture. After a fault the device is closed."""
        taken = self._read() if self._video is not None else self._open()
        if taken.fault:
            self.close()
        return taken

    def close(self) -> None:
        video, self._video, self._before = self._video, None, None
        if video is not None:
            video.release()

    def _open(self) -> Taken:
        path = self._config.path
        if fault := self._there(path):
            return Taken(fault)
        video = self._open_video(self._config)
        if not video.isOpened():
            video.release()
            return Taken(f"the camera {path} cannot be opened: does another program use it?")
        self._video, self._changed_ns = video, self._now_ns()
        return Taken()

    def _read(self) -> Taken:
        assert self._video is not None
        config = self._config
        done, picture = self._video.read()
        arrived_ns = self._now_ns()
        if not done or picture is None:
            gone = self._there(config.path)
            return Taken(f"the camera was unplugged: {gone}" if gone else f"the camera {config.path} sends no pictures")
        if picture.shape != (config.height, config.width, 3):
            height, width = picture.shape[:2]
            return Taken(
                f"the camera {config.path} sends {width} x {height} pixels, not {config.width} x {config.height}: set"
                " width and height to a size that it has (`v4l2-ctl --list-formats-ext`)"
            )
        if self._before is not None and np.array_equal(picture, self._before):
            frozen = arrived_ns - self._changed_ns > FROZEN_NS
            return Taken("the camera's picture does not change: it hangs, or its lens is covered" if frozen else "")
        self._before, self._changed_ns = picture.copy(), arrived_ns
        colour = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        return Taken("", self._exposed_ns(arrived_ns), colour)

    def _exposed_ns(self, arrived_ns: int) -> int:
        assert self._video is not None
        buffer_ns = round(self._video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        self.by_driver = buffer_ns > 0 and 0 <= arrived_ns - buffer_ns <= OLDEST_NS
        if not self.by_driver:
            return arrived_ns - round(self._config.least_age_s * NS)
        # A picture begins to arrive when its exposure, of at most a period, has ended.
        return buffer_ns - round(NS / self._config.rate_hz / 2)


def device_fault(path: str) -> str:
    """What is wrong with a device's file, a sentence; '' when this user may open it."""
    if not Path(path).exists():
        return f"{path} is not there: is the camera plugged in?"
    if not os.access(path, os.R_OK | os.W_OK):
        return f"{path} may not be opened by this user: add the user to the group `video`"
    return ""


def open_video(config: KinectConfig) -> Video:
    """Open a device by Video4Linux, with its pictures in the configured size."""
    options = [
        cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FRAME_WIDTH, config.width, cv2.CAP_PROP_FRAME_HEIGHT, config.height,
        cv2.CAP_PROP_FPS, round(config.rate_hz), cv2.CAP_PROP_BUFFERSIZE, 1,
    ]  # fmt: skip
    return cv2.VideoCapture(config.path, cv2.CAP_V4L2, options)


class UvcCamera:
    """A UVC camera. Calls `on_fault(fault)` in the running event loop whenever the fault changes."""

    def __init__(
        self, config: KinectConfig, clock: Clock, on_fault: OnFault, open_video: OpenVideo = open_video
    ) -> None:
        self._clock = clock
        self._on_fault = on_fault
        self._fault = OPENING
        self._loop = asyncio.get_running_loop()
        self._newest: Taken | None = None
        self._came = asyncio.Event()
        self._ends = threading.Event()
        self._reader = UvcReader(config, open_video)
        # A thread that hangs in the device's driver must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="uvc", daemon=True)
        on_fault(self._fault)
        self._thread.start()

    @property
    def stamps(self) -> str:
        """Where the pictures' stamps are from."""
        return "stamps by its driver" if self._reader.by_driver else "stamps by arrival"

    async def frames(self) -> AsyncGenerator[RawFrame, None]:
        while True:
            try:
                async with asyncio.timeout(SILENT_S):
                    await self._came.wait()
            except TimeoutError:
                if not self._fault or self._fault == OPENING:
                    self._report("the camera's driver hangs: unplug the camera and plug it in again")
                continue
            self._came.clear()
            if self._newest is not None:
                taken, self._newest = self._newest, None
                assert taken.colour is not None
                age_ns = time.monotonic_ns() - taken.at_ns
                yield RawFrame(self._clock.now_ns() - age_ns, taken.colour, None)

    def tilt(self, angle_rad: float) -> None:
        """It has no motor."""

    def led(self, led: LED) -> None:
        """Its light, if any, is its own matter."""

    def close(self) -> None:
        self._ends.set()

    def _run(self) -> None:
        try:
            while not self._ends.is_set():
                taken = self._reader.step()
                self._loop.call_soon_threadsafe(self._take, taken)
                if taken.fault:
                    self._ends.wait(AGAIN_S)
        except RuntimeError:  # the loop is closed: nobody is left to tell
            pass
        finally:
            self._reader.close()

    def _take(self, taken: Taken) -> None:
        if taken.fault:
            self._report(taken.fault)
        elif taken.colour is not None:
            self._newest = taken
            self._came.set()
            self._report("")

    def _report(self, fault: str) -> None:
        if fault != self._fault and not self._ends.is_set():
            self._fault = fault
            self._on_fault(fault)
