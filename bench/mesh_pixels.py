"""The frame that `bench.mesh` sends: two arrays of pixels, as a camera delivers them."""

from __future__ import annotations

import numpy as np

WIDTH, HEIGHT = 640, 480
_draw = np.random.default_rng(WIDTH)
colour = _draw.integers(0, 256, WIDTH * HEIGHT * 3, dtype=np.uint8)
"""RGB, 8 bits a channel."""
depth = _draw.integers(0, 256, WIDTH * HEIGHT * 2, dtype=np.uint8)
"""Codes of 16 bits, as bytes."""
