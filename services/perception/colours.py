"""Finds which known objects' colours each pixel has, with one table lookup for all objects."""

from __future__ import annotations

import cv2
import numpy as np

from cocoro.arrays import BoolArray, CodeArray, ImageArray
from cocoro.objects import Catalogue
from services.perception.cielab import lab_of, matches

__all__ = ["ColourLayer", "ColourTable", "lab_of", "matches"]

MOST_OBJECTS = 255
"""Number of objects that one byte per pixel distinguishes from the background."""


class ColourLayer:
    """Known objects of which no two share a colour: a pixel has the colour of one of them, or of none."""

    def __init__(self) -> None:
        self.table: ImageArray = np.zeros(65536, dtype=np.uint8)
        """For each colour of 5, 6 and 5 bits 1 + the object's number in the catalogue, or 0 for none."""

    def take(self, number: int, own: BoolArray) -> bool:
        """Add the catalogue's object of that number, whose colours `own` tells, shape (65536,). False, and nothing is
        added, when another object of the layer has one of its colours."""
        if self.table[own].any():
            return False
        self.table[own] = 1 + number
        return True


class ColourTable:
    """The catalogue's CIELAB boxes, including shared ones, tabulated over RGB with 5, 6 and 5 bits.

    Converting a frame to CIELAB and comparing it with every box takes milliseconds. OpenCV packs it to 5-6-5 bits
    in a tenth of a millisecond, and one lookup in each layer then serves all objects. Objects that share a colour are
    in different layers.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        """Raises ValueError for more than 255 objects."""
        if len(catalogue) > MOST_OBJECTS:
            raise ValueError(f"{len(catalogue)} known objects; a colour table holds {MOST_OBJECTS}")
        codes = np.arange(65536, dtype=np.uint16).view(np.uint8).reshape(256, 256, 2)
        corner = np.asarray(cv2.cvtColor(codes, cv2.COLOR_BGR5652RGB), dtype=np.uint8)
        # Each cell is represented by its middle; cells are 8 wide in red and blue, 4 in green.
        kept, half = np.array([[0xF8, 0xFC, 0xF8], [4, 2, 4]], dtype=np.uint8)
        lab = lab_of((corner & kept) + half).reshape(-1, 3)
        self.layers: list[ColourLayer] = []
        self.layer_of: list[int] = []
        """Each object's layer."""
        for number, known in enumerate(catalogue):
            own = matches(known, lab, by_shape=True)
            free = (place for place, layer in enumerate(self.layers) if layer.take(number, own))
            place = next(free, len(self.layers))
            if place == len(self.layers):
                self.layers.append(ColourLayer())
                self.layers[place].take(number, own)
            self.layer_of.append(place)

    @staticmethod
    def packed(colour: ImageArray) -> CodeArray:
        """Each pixel's colour with 5, 6 and 5 bits, shape (height, width), the index into a layer's table; `colour` is
        RGB, shape (height, width, 3).

        A 3 x 3 mean filter first reduces the sensor's noise to a third and removes single wild pixels.
        """
        packed = np.asarray(cv2.cvtColor(cv2.blur(colour, (3, 3)), cv2.COLOR_RGB2BGR565), dtype=np.uint8)
        codes: CodeArray = packed.view(np.uint16)[..., 0]
        return codes
