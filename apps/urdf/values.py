"""Numbers in the attributes of a URDF's elements."""

from __future__ import annotations

from math import isfinite
from xml.etree.ElementTree import Element

from apps.urdf.model import HERE
from cocoro.kinematics import Origin
from cocoro.units import Vec3

GREATEST = 1e20
"""Of any value: a torque or limit that means `none` may be huge, and what is computed with it must stay finite."""
FARTHEST = 1e4
"""Of a value of three: a length, m, an angle, or a direction."""


class UrdfError(Exception):
    """A file that is no URDF, or none that a description can be made of; without the file's name."""


def number(element: Element | None, name: str, where: str) -> float | None:
    """An attribute's value; None when it is not there. Raises UrdfError for what is no number."""
    text = None if element is None else element.get(name)
    return None if text is None or element is None else _float(text, element, name, where)


def vector(element: Element, name: str, where: str, default: Vec3) -> Vec3:
    """An attribute's three values. Raises UrdfError for what is not three numbers."""
    text = element.get(name)
    if text is None:
        return default
    words = text.split()
    if len(words) != 3:
        raise UrdfError(f"{where}: {name}={text!r} of <{element.tag}> is not three numbers")
    x, y, z = (_float(word, element, name, where, FARTHEST) for word in words)
    return x, y, z


def origin(element: Element, where: str) -> Origin:
    """The place of an element in its link's frame, of a joint in its parent's."""
    found = element.find("origin")
    if found is None:
        return HERE
    return Origin(vector(found, "xyz", where, HERE.xyz_m), vector(found, "rpy", where, HERE.rpy_rad))


def _float(text: str, element: Element, name: str, where: str, greatest: float = GREATEST) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value) or abs(value) > greatest:
        raise UrdfError(f"{where}: {name}={text!r} of <{element.tag}> is not a number, or too large")
    return value
