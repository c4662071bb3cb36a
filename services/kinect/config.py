"""The Kinect service's settings."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class KinectConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str = "freenect"
    """The driver's name."""
    library: str = ""
    """A libfreenect of one's own; the system's where nothing is said."""
    recording: str = ""
    """A recording of fakenect's to play, over and over, in the place of a device."""
    tilt_deg: Annotated[float, Meta(ge=-30, le=30)] = 0.0
    """To which the device's own tilt motor is put: the robot's description wants 0."""
    latency_s: Annotated[float, Meta(ge=0, le=0.2)] = 0.033
    """From the middle of a picture's exposure to its arrival, at the least: half an exposure and the time that it takes
    to be read out and sent. An estimate: it has not been measured on a device."""
