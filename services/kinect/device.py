"""What a depth camera's driver has to offer; a driver is one entry in `DEVICES`."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from typing import NamedTuple, Protocol

from cocoro.arrays import CodeArray, ImageArray
from cocoro.clock import Clock
from cocoro.errors import ConfigError
from services.kinect.config import Config
from services.kinect.freenect import LED

Tell = Callable[[str], None]
"""Called with what keeps pictures from coming, in a sentence; with '' when they come again."""


class Shot(NamedTuple):
    """One colour and depth pair."""

    stamp_ns: int
    """Of the middle of the exposure, by the robot's clock."""
    colour: ImageArray
    """RGB, (height, width, 3)."""
    depth: CodeArray
    """Raw 11-bit codes as the depth camera sees them, (height, width); 2047 is no data."""


class DepthCamera(Protocol):
    """A device that is open. It may lose its cable: `shots` then waits until it is back."""

    def shots(self) -> AsyncIterator[Shot]:
        """Every pair as it comes; a pair that nobody took in time is dropped for the next."""

    def tilt(self, angle_rad: float) -> None:
        """Move the device's own tilt motor (the Calliope's stays at 0: its neck tilts)."""

    def led(self, led: LED) -> None: ...

    def close(self) -> None: ...


Open = Callable[[Config, Clock, Tell], DepthCamera]

DEVICES: dict[str, Open] = {}
"""Drivers by name. Raise ConfigError, naming the package to install, when their library is missing."""


def open_device(config: Config, clock: Clock, tell: Tell) -> DepthCamera:
    """Raises ConfigError for a driver that is not there."""
    from services.kinect import camera  # enters the real one

    DEVICES.setdefault("freenect", camera.FreenectCamera)
    if config.device not in DEVICES:
        raise ConfigError(f"kinect: there is no driver {config.device!r} (known: {', '.join(DEVICES)})")
    return DEVICES[config.device](config, clock, tell)
