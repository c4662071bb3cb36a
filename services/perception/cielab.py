"""Colours of the catalogue of known objects: CIELAB, and boxes in it."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from cocoro.arrays import BoolArray, Float32Array, ImageArray
from cocoro.objects import LabBox, ObjectSpec

Lab = Float32Array


def prepare() -> None:
    """Make OpenCV's tables for `lab_of` in advance: the first conversion of a process makes them, in 0.1 s without the
    interpreter. Others wait for it."""
    lab_of(np.zeros((1, 3), dtype=np.uint8))


def lab_of(colour: ImageArray) -> Lab:
    """8-bit sRGB (..., 3) to CIELAB (D65) (..., 3): L 0 to 100, a and b about -128 to 127."""
    flat = np.ascontiguousarray(colour).reshape(1, -1, 3).astype(np.float32) / np.float32(255)
    return np.asarray(cv2.cvtColor(flat, cv2.COLOR_RGB2Lab), dtype=np.float32).reshape(colour.shape)


def in_boxes(boxes: Iterable[LabBox], lab: Lab) -> BoolArray:
    """Whether each CIELAB colour (..., 3) is in any of the boxes; shape (...)."""
    found = np.zeros(lab.shape[:-1], dtype=np.bool_)
    channels = [np.ascontiguousarray(lab[..., number]) for number in range(3)]
    for box in boxes:
        inside = np.ones_like(found)
        for channel, low, high in zip(channels, box.low, box.high, strict=True):
            inside &= (channel >= np.float32(low)) & (channel <= np.float32(high))
        found |= inside
    return found


def matches(known: ObjectSpec, lab: Lab, *, by_shape: bool = False) -> BoolArray:
    """Whether each CIELAB colour (..., 3) is the object's, with `by_shape` also one that it shares; shape (...)."""
    return in_boxes(known.lab + known.lab_by_shape if by_shape else known.lab, lab)
