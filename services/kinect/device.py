"""The interface of a depth camera's driver, and the settings of the Kinect service."""

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
    """The settings of the Kinect service."""

    device: str = "freenect"
    """Name of the driver."""
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
    """A colour image and a depth image of the same moment, as the device delivers them."""

    stamp_ns: int
    """Middle of the exposure, robot's clock."""
    colour: ImageArray
    """RGB, (height, width, 3)."""
    depth: CodeArray
    """Raw 11-bit codes from the depth camera's viewpoint, (height, width); 2047 is no data."""


class DepthCamera(Protocol):
    """A device that is open. When its cable is pulled, `frames` waits until it is back."""

    def frames(self) -> AsyncIterator[RawFrame]:
        """Yield each frame as it comes; a frame that nobody takes in time is replaced by the next."""

    def tilt(self, angle_rad: float) -> None:
        """Move the device's own tilt motor. The Calliope's stays at 0, since its neck tilts."""

    def led(self, led: LED) -> None:
        """Set the device's light."""

    def close(self) -> None: ...


DriverFactory = Callable[[KinectConfig, Clock, OnFault], DepthCamera]
"""Opens a device. Raises ConfigError that names the package to install when the driver's library is missing."""
