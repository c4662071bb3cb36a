"""Random numbers of one run: separate named streams from one seed, so that adding a draw to one part of the
simulator changes nothing in the others."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The generator of the named part of the run `seed`. Equal arguments give equal draws, on any machine."""
    return np.random.default_rng(np.random.SeedSequence([seed, crc32(name.encode())]))
