"""The interface of a camera's driver, and the settings of the camera's service, `kinect`."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from typing import Annotated, NamedTuple, Protocol

import msgspec
from msgspec import Meta

from cocoro.arrays import CodeArray, ImageArray
from cocoro.clock import Clock
from services.kinect.freenect import LED

OnFault = Callable[[str], None]
"""Called with a sentence that says why no frames come, and with '' when they come again."""


class KinectConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The settings of the camera's service."""

    device: str = "freenect"
    """Name of the driver: `freenect` for a Kinect, `uvc` for a colour camera on USB."""
    path: str = "/dev/video0"
    """File of a `uvc` device; a name in /dev/v4l/by-id stays the same when cameras are plugged in another order."""
    width: Annotated[int, Meta(ge=64, le=4096)] = 640
    height: Annotated[int, Meta(ge=48, le=4096)] = 480
    rate_hz: Annotated[float, Meta(gt=0, le=240)] = 30.0
    """Size and rate of the pictures that a `uvc` device is asked for."""
    library: str = ""
    """Path of a libfreenect; by default the system's."""
    recording: str = ""
    """Folder of a fakenect recording that is played in a loop instead of a device."""
    tilt_deg: Annotated[float, Meta(ge=-30, le=30)] = 0.0
    """Angle of the device's own tilt motor. The robot's description assumes 0."""
    least_age_s: Annotated[float, Meta(ge=0, le=0.2)] = 0.033
    """Least age of an image at its arrival, from the middle of its exposure: half an exposure, read-out and transfer.
    An estimate that has not been measured on a device."""


class RawFrame(NamedTuple):
    """A colour image and, from a device that measures it, a depth image of the same moment, as they are delivered."""

    stamp_ns: int
    """Middle of the exposure, robot's clock."""
    colour: ImageArray
    """RGB, (height, width, 3)."""
    depth: CodeArray | None
    """Codes from the depth camera's viewpoint, (height, width), as the robot's description says; None without depth."""


class DepthCamera(Protocol):
    """A device that is open, with depth or without. When its cable is pulled, `frames` waits until it is back."""

    def frames(self) -> AsyncIterator[RawFrame]:
        """Yield each frame as it comes; a frame that nobody takes in time is replaced by the next."""

    def tilt(self, angle_rad: float) -> None:
        """Move the device's own tilt motor. The Calliope's stays at 0, since its neck tilts."""

    def led(self, led: LED) -> None:
        """Set the device's light."""

    def close(self) -> None: ...


DriverFactory = Callable[[KinectConfig, Clock, OnFault], DepthCamera]
"""Opens a device. Raises ConfigError that names the package to install when the driver's library is missing."""
