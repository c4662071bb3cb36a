"""The rates that are meant on one robot: those of the topics' table, except where its profile says otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cocoro.topics import DETECTIONS, FRAME, Topic

OFF_SHARE = 0.15
"""A rate is off when it differs from the meant one by more than this share of it."""
_OF_THE_CAMERA = (FRAME.name, DETECTIONS.name)
_CAMERAS = ("sim", "kinect")


def meant_hz(topic: Topic[Any] | None, resolved: Mapping[str, Any]) -> float | None:
    """The rate that a topic has on the robot with this resolved profile; None when it is published on change, or is not
    known here."""
    if topic is None or topic.name not in _OF_THE_CAMERA:
        return None if topic is None else topic.rate_hz
    services = resolved.get("service", {})
    rates = (services.get(name, {}).get("frame_rate_hz") for name in _CAMERAS if name in resolved.get("processes", ()))
    return next((float(rate) for rate in rates if isinstance(rate, int | float)), topic.rate_hz)


def off(rate_hz: float, meant_hz: float | None) -> str:
    """'slower than meant' or 'faster than meant'; '' when the rate is as it is meant, or none is."""
    if not meant_hz or abs(rate_hz / meant_hz - 1.0) <= OFF_SHARE:
        return ""
    return f"{'faster' if rate_hz > meant_hz else 'slower'} than meant"
