"""Renders the simulated world: an interface, a fast renderer and a fallback.

`make_renderer` chooses moderngl where EGL is available (a few milliseconds per frame, no display needed), otherwise
PyBullet's TinyRenderer (about 100 ms per view, needs nothing).
"""

from sim.render.choice import make_renderer, prepare
from sim.render.interface import Images, Lighting, Renderer

__all__ = ["Images", "Lighting", "Renderer", "make_renderer", "prepare"]
