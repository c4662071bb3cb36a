"""Finds which known objects' colours each pixel has, with one table lookup for all objects."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import ImageArray
from cocoro.objects import Catalogue
from services.perception.cielab import lab_of, matches

__all__ = ["Classes", "ColourTable", "lab_of", "matches"]

Classes = NDArray[Any]
"""One unsigned integer per pixel, shape (height, width); bit i stands for the catalogue's i-th object."""


class ColourTable:
    """The catalogue's CIELAB boxes, including shared ones, tabulated over RGB with 5, 6 and 5 bits.

    Converting a frame to CIELAB and comparing it with every box takes milliseconds. OpenCV packs it to 5-6-5 bits
    in a tenth of a millisecond, and one lookup then serves all objects.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        """Raises ValueError for more than 32 objects, the number of bits of a pixel's class."""
        if len(catalogue) > 32:
            raise ValueError(f"{len(catalogue)} known objects; a colour table holds 32")
        dtype = np.uint8 if len(catalogue) <= 8 else np.uint16 if len(catalogue) <= 16 else np.uint32
        codes = np.arange(65536, dtype=np.uint16).view(np.uint8).reshape(256, 256, 2)
        corner = np.asarray(cv2.cvtColor(codes, cv2.COLOR_BGR5652RGB), dtype=np.uint8)
        # Each cell is represented by its middle; cells are 8 wide in red and blue, 4 in green.
        kept, half = np.array([[0xF8, 0xFC, 0xF8], [4, 2, 4]], dtype=np.uint8)
        lab = lab_of((corner & kept) + half).reshape(-1, 3)
        table = np.zeros(65536, dtype=np.uint32)
        for bit, known in enumerate(catalogue):
            table |= matches(known, lab, by_shape=True).astype(np.uint32) << np.uint32(bit)
        self._table: Classes = table.astype(dtype)

    def classify(self, colour: ImageArray) -> Classes:
        """The objects whose colours each pixel has, as bits, shape (height, width); `colour` is RGB, shape (height,
        width, 3).

        A 3 x 3 mean filter first reduces the sensor's noise to a third and removes single wild pixels.
        """
        packed = np.asarray(cv2.cvtColor(cv2.blur(colour, (3, 3)), cv2.COLOR_RGB2BGR565))
        found: Classes = self._table.take(packed.view(np.uint16)[..., 0])
        return found
