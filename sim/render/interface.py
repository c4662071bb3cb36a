"""The interface of a renderer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.robot import Camera


class Lighting(Protocol):
    """A distant lamp and ambient light."""

    @property
    def ambient(self) -> float:
        """Share of a surface's colour that is visible in shadow, 0 to 1."""

    @property
    def diffuse(self) -> float:
        """Share that the lamp adds at perpendicular incidence, 0 to 1."""

    @property
    def direction(self) -> tuple[float, float, float]:
        """Direction in which the lamp's light travels, world frame; any length except zero."""

    @property
    def temperature_k(self) -> float:
        """Colour temperature of the lamp. The camera is balanced for 6500 K, so that this is white."""


class Images(NamedTuple):
    """The images of one frame. The renderer owns the arrays, and overwrites them at its next `render`."""

    colour: ImageArray
    """RGB, (height, width, 3), from the colour camera."""
    depth_m: Float32Array
    """Metres along the depth camera's optical axis, (height, width); infinite where there is nothing. With a projector,
    pixels that its light does not reach have the NEGATIVE of their depth."""


class Renderer(Protocol):
    """Draws the visuals that it was made with. Both cameras have the intrinsics `camera`.

    A camera's frame is x right, y down, z forward. Equal inputs give equal bytes, also in different processes.
    """

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> Camera: ...

    def render(
        self,
        poses: FloatArray,
        camera_pose: FloatArray,
        depth_camera_pose: FloatArray,
        light: Lighting,
        projector_pose: FloatArray | None = None,
    ) -> Images:
        """Draw a frame. `poses`: world poses of the visuals in their order, (n, 4, 4); the other poses are (4, 4)."""

    def close(self) -> None:
        """Release all resources. The renderer must not be used afterwards."""


Shape = Literal["box", "cylinder", "sphere"]


@dataclass(frozen=True)
class Visual:
    """A coloured rigid primitive, centred on its own frame. `World.visual_poses` gives the frame's pose."""

    name: str
    shape: Shape
    size_m: tuple[float, ...]
    """box: full x, y, z; cylinder: radius, height (its axis is z); sphere: radius."""
    rgb: tuple[float, float, float]
    """Surface colour, 0 to 1 per channel."""
