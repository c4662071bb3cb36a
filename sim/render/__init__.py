"""Pictures of the simulated world: one small interface, a fast renderer and a fallback.

`make_renderer` chooses: moderngl where EGL is there (a few milliseconds a frame, no display needed), else
PyBullet's TinyRenderer (some 100 ms a view, needs nothing).
"""

from sim.render.interface import Images, Lighting, Renderer, make_renderer

__all__ = ["Images", "Lighting", "Renderer", "make_renderer"]
