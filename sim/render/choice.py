"""The choice of the renderer that runs on this machine."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from typing import Literal

from cocoro.errors import ConfigError
from cocoro.robot import Camera
from sim.render.interface import Renderer, Visual

_log = logging.getLogger(__name__)

MISSING_EGL = (
    "slow pictures: no OpenGL on EGL here (%s), so PyBullet's TinyRenderer draws;"
    " for the fast one: apt install libegl1 libgl1 libgl1-mesa-dri"
)

RendererChoice = Literal["auto", "moderngl", "tiny"]


def prepare() -> None:
    """Make what all renderers of a process share, in advance. `make_renderer` tells what is missing."""
    with suppress(Exception):  # moderngl and glcontext raise plain Exception for a missing library
        from sim.render.gl import context

        context()


def make_renderer(visuals: Sequence[Visual], camera: Camera, choice: RendererChoice = "auto") -> Renderer:
    """Make the chosen renderer. With `auto` that is the fast one, or the slow one and a warning when the fast one
    cannot run.

    Raises ConfigError when `moderngl` is chosen and cannot run.
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
