"""The settings of the Kinect service."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class KinectConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str = "freenect"
    """Name of the driver."""
    library: str = ""
    """Path of a libfreenect; by default the system's."""
    recording: str = ""
    """Folder of a fakenect recording that is played in a loop instead of a device."""
    tilt_deg: Annotated[float, Meta(ge=-30, le=30)] = 0.0
    """Angle of the device's own tilt motor. The robot's description assumes 0."""
    latency_s: Annotated[float, Meta(ge=0, le=0.2)] = 0.033
    """Least time from the middle of an exposure to the arrival of its image: half an exposure, read-out and transfer.
    An estimate that has not been measured on a device."""
