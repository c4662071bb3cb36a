"""Random numbers of a run: a separate stream for each part of the simulator, so that an added draw in one part changes
nothing in the others."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The random generator of the part `name` in the run `seed`. Equal arguments give equal draws on any machine."""
    return np.random.default_rng(np.random.SeedSequence([seed, crc32(name.encode())]))
