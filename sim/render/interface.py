"""What the camera asks of a renderer."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.errors import ConfigError
from cocoro.robot import Camera


class Lighting(Protocol):
    """One lamp far away and the light that the room throws back."""

    @property
    def ambient(self) -> float:
        """Share of a surface's colour that it shows in shadow, 0 to 1."""

    @property
    def diffuse(self) -> float:
        """Share that the lamp adds where it falls straight on the surface, 0 to 1."""

    @property
    def direction(self) -> tuple[float, float, float]:
        """Where the lamp's light goes, world frame; its length does not matter."""

    @property
    def temperature_k(self) -> float:
        """Colour temperature; the camera is balanced for 6500 K, so that is white."""


class Images(NamedTuple):
    """One look at the world. The arrays are the renderer's own: they hold until its next `render`."""

    colour: ImageArray
    """height x width x 3, RGB, the colour camera's view."""
    depth_m: Float32Array
    """height x width, metres along the depth camera's optical axis, from that camera's own pose; infinite where
    there is nothing. NEGATIVE (the same metres) where the projector's light does not reach, if a projector
    was given."""


class Renderer(Protocol):
    """Draws the visuals that it was made with. Both cameras have the intrinsics `camera`.

    Poses are 4 x 4 transforms to the world; a camera's frame is x right, y down, z forward. Equal inputs
    give equal bytes, in this process and in another one.
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
        """One frame. `poses` is (n, 4, 4) in the order of the visuals."""

    def close(self) -> None:
        """Give back what was taken; the renderer must not be used after it."""


Shape = Literal["box", "cylinder", "sphere"]


@dataclass(frozen=True)
class Visual:
    """One primitive, centred on its own frame; where that frame stands is said by `World.visual_poses`."""

    name: str
    shape: Shape
    size_m: tuple[float, ...]
    """box: full x, y, z; cylinder: radius, height (its axis is z); sphere: radius."""
    rgb: tuple[float, float, float]
    """Surface colour, 0 to 1 a channel."""


_log = logging.getLogger(__name__)

MISSING_EGL = (
    "slow pictures: no OpenGL on EGL here (%s), so PyBullet's TinyRenderer draws;"
    " for the fast one: apt install libegl1 libgl1 libgl1-mesa-dri"
)

RendererChoice = Literal["auto", "moderngl", "tiny"]


def make_renderer(visuals: Sequence[Visual], camera: Camera, choice: RendererChoice = "auto") -> Renderer:
    """The fast renderer, or by `auto` the slow one where that cannot run, with one logged warning.

    Raises ConfigError when `moderngl` is demanded and cannot run.
    """
    if choice != "tiny":
        try:
            from sim.render.gl import GlRenderer

            renderer: Renderer = GlRenderer(visuals, camera)
            return renderer
        except Exception as error:  # moderngl and glcontext raise plain Exception for a missing library
            reason = " ".join(str(error).split()) or type(error).__name__
            if choice == "moderngl":
                raise ConfigError(
                    f"the moderngl renderer cannot run here ({reason}): apt install libegl1 libgl1"
                    " libgl1-mesa-dri, or let the renderer be chosen (auto)"
                ) from error
            _log.warning(MISSING_EGL, reason)
    from sim.render.tiny import TinyRenderer

    return TinyRenderer(visuals, camera)
