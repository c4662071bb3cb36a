"""A frame as a picture for people, with what perception made of it drawn in."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cocoro.arrays import ImageArray
from cocoro.errors import CocoroError
from cocoro.messages import Detection, Detections, Frame
from cocoro.objects import Catalogue
from cocoro.units import Rgb
from services.kinect.picture import save

LOCALISED: Rgb = (255, 255, 255)
UNLOCALISED: Rgb = (255, 160, 0)
TEXT_BACK: Rgb = (20, 20, 20)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def colour_of(frame: Frame) -> ImageArray:
    """The frame's colour pixels, RGB, (height, width, 3); a view, not to be written to."""
    return np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)


def draw(frame: Frame, detections: Detections | None = None, catalogue: Catalogue | None = None) -> ImageArray:
    """A copy of the colour image with each detection's box, centroid, label, distance and note; RGB.

    The distance is from the body frame's origin, level. With a catalogue each box has its object's colour. A frame
    with other than the detections' pixel size is drawn on at its own size.
    """
    image = colour_of(frame).copy()
    if detections is not None:
        scale = frame.width / detections.width, frame.height / detections.height
        for detection in detections.detections:
            known = catalogue.get(detection.label) if catalogue is not None else None
            fallback = LOCALISED if detection.position_m is not None else UNLOCALISED
            colour = _bright(known.rgb) if known is not None else fallback
            _draw_detection(image, detection, colour, scale)
    return image


def captioned(image: ImageArray, caption: str) -> None:
    """Write a line at the bottom of an RGB image."""
    _text(image, caption, 4, image.shape[0] - 5, LOCALISED)


def save_png(image: ImageArray, path: Path) -> None:
    """Write an RGB image as PNG, making the folder. Raises CocoroError when it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), path)
    except OSError as error:
        raise CocoroError(f"picture {path}: {error.strerror}; choose another place for it") from error


def describe(detection: Detection) -> str:
    """One line: label, distance or why there is none."""
    words = [detection.label]
    if detection.position_m is not None:
        words.append(f"{np.hypot(*detection.position_m[:2]):.2f} m")
    if detection.note:
        words.append(f"({detection.note})")
    return " ".join(words)


def _draw_detection(image: ImageArray, detection: Detection, colour: Rgb, scale: tuple[float, float]) -> None:
    left, top, right, bottom = (round(edge * factor) for edge, factor in zip(detection.box_px, scale * 2, strict=True))
    cv2.rectangle(image, (left - 2, top - 2), (right + 1, bottom + 1), TEXT_BACK, 3)
    cv2.rectangle(image, (left - 2, top - 2), (right + 1, bottom + 1), colour, 1)
    centre = round(detection.u_px * scale[0]), round(detection.v_px * scale[1])
    cv2.drawMarker(image, centre, TEXT_BACK, cv2.MARKER_CROSS, 9, 3)
    cv2.drawMarker(image, centre, LOCALISED, cv2.MARKER_CROSS, 9, 1)
    above = top - 6
    _text(image, describe(detection), left - 2, above if above > 14 else bottom + 16, colour)


def _text(image: ImageArray, text: str, left: int, baseline: int, colour: Rgb) -> None:
    size = max(0.35, 0.45 * image.shape[1] / 640)
    (width, height), below = cv2.getTextSize(text, FONT, size, 1)
    left = max(0, min(left, image.shape[1] - width))
    cv2.rectangle(image, (left - 1, baseline - height - 2), (left + width + 1, baseline + below), TEXT_BACK, cv2.FILLED)
    cv2.putText(image, text, (left, baseline), FONT, size, colour, 1, cv2.LINE_AA)


def _bright(rgb: tuple[float, float, float]) -> Rgb:
    """An object's colour, light enough to be read on dark ground."""
    red, green, blue = (round(255 * (0.35 + 0.65 * channel)) for channel in rgb)
    return red, green, blue
