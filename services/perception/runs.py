"""Runs: pixels side by side in a row of the image. A region of hundreds of pixels has some dozens of them, and is
measured by them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from cocoro.arrays import BoolArray, ImageArray, IntArray


@dataclass(frozen=True)
class Runs:
    """m runs; each attribute has the shape (m,)."""

    row: IntArray
    left: IntArray
    """Row, and column of the first pixel, in the image."""
    begin: IntArray
    """Place of the first pixel in the flattened image."""
    length: IntArray

    @classmethod
    def of(cls, begin: IntArray, end: IntArray, width: int, corner: tuple[int, int], image_width: int) -> Runs:
        """The runs from and up to these places in a flattened picture that is `width` wide, and whose first pixel is
        the image's pixel `corner`, (column, row)."""
        row = begin // width
        left = begin - row * width + corner[0]
        row += corner[1]
        return cls(row, left, row * image_width + left, end - begin)

    @classmethod
    def joined(cls, parts: list[Runs]) -> Runs:
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def among(self, chosen: BoolArray | slice) -> Runs:
        """Some of the runs."""
        return Runs(self.row[chosen], self.left[chosen], self.begin[chosen], self.length[chosen])

    @property
    def first(self) -> IntArray:
        """Each run's first pixel among those of all runs."""
        return self.length.cumsum() - self.length

    @cached_property
    def at(self) -> IntArray:
        """The pixels' places in the flattened image, shape (k,)."""
        return spread_out(self.begin, self.length)


def run_ends(picture: ImageArray) -> tuple[IntArray, IntArray]:
    """Where in the flattened picture the runs of equal pixels begin, and where they end (exclusive). The first and the
    last column are 0, and pixels of 0 are in no run."""
    flat = picture.reshape(-1)
    changes = 1 + np.flatnonzero(flat[1:] != flat[:-1])
    return changes[flat.take(changes) != 0], changes[flat.take(changes - 1) != 0]


def spread_out(first: IntArray, count: IntArray) -> IntArray:
    """The numbers from each of `first` on, so many as `count` tells, shape (sum of the counts,)."""
    numbers: IntArray = (first - count.cumsum() + count).repeat(count)
    numbers += np.arange(len(numbers))
    return numbers
