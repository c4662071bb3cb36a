"""Reads a URDF file.

Not by a library: yourdfpy 0.0.60 brings 32 others with 284 MB (trimesh and what it needs), and urdf-parser-py 0.0.4
brings 15 MB and takes a joint on a link that does not exist without a word. What a description needs is read here in
200 lines with the standard library's parser, whose expat (2.4.1 and later) bounds what entities may expand to; a file
that declares any is refused.
"""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from apps.urdf.model import CONTINUOUS, FIXED, REVOLUTE, Inertial, Urdf, UrdfJoint, UrdfLink
from apps.urdf.shapes import solids_of
from apps.urdf.values import UrdfError, number, origin, vector
from cocoro.errors import ConfigError

LEAST = 1e-6
"""Torque, N m, and speed, rad/s, below which there is none."""
ENDLESS_RAD = 100.0
"""Limits beyond are none."""
KINDS = (FIXED, REVOLUTE, CONTINUOUS)
XACRO = "{http://www.ros.org/wiki/xacro}"


def read(path: Path) -> Urdf:
    """Read a URDF. Meshes are looked for beside the file. Raises ConfigError that names file and element: for a file
    that cannot be read or is no URDF, for links that do not form one tree, and for joints that a description cannot
    have."""
    try:
        return _robot(_parsed(path), path.parent)
    except UrdfError as error:
        raise ConfigError(f"{path}: {error}") from error


class _Builder(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> NoReturn:
        raise UrdfError("has a document type declaration, which no URDF needs")


def _parsed(path: Path) -> Element:
    try:
        return ElementTree.fromstring(path.read_bytes(), ElementTree.XMLParser(target=_Builder()))
    except OSError as error:
        raise UrdfError(f"cannot be read: {error.strerror}") from error
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # the latter two: an encoding
        raise UrdfError(f"is not XML: {error}") from error


def _robot(robot: Element, folder: Path) -> Urdf:
    if robot.tag != "robot":
        raise UrdfError(f"is no URDF: its outermost element is <{robot.tag}>, not <robot>")
    if any(element.tag.startswith(XACRO) for element in robot.iter()):
        raise UrdfError("is a xacro, not yet a URDF; expand it first: xacro FILE > robot.urdf")
    links: dict[str, UrdfLink] = {}
    for element in robot.findall("link"):
        link = _link(element, folder)
        if link.name in links:
            raise UrdfError(f"link {link.name} is there twice")
        links[link.name] = link
    if not links:
        raise UrdfError("has no links")
    joints: dict[str, UrdfJoint] = {}
    for element in robot.findall("joint"):
        joint = _joint(element)
        if joint.name in joints:
            raise UrdfError(f"joint {joint.name} is there twice")
        joints[joint.name] = joint
    return _tree(robot.get("name", "robot"), links, joints)


def _tree(name: str, links: dict[str, UrdfLink], joints: dict[str, UrdfJoint]) -> Urdf:
    above: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise UrdfError(f"joint {joint.name}: its {role} {link!r} is not a link")
        if joint.child in above:
            raise UrdfError(
                f"link {joint.child} is the child of two joints, {above[joint.child].name} and {joint.name}"
            )
        above[joint.child] = joint
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        raise UrdfError(
            f"has {len(roots)} roots, links without a joint above them: {', '.join(roots)}; a robot has one"
        )
    below: dict[str, list[UrdfJoint]] = {}
    for joint in joints.values():
        below.setdefault(joint.parent, []).append(joint)
    ordered: dict[str, UrdfJoint] = {}
    waiting = roots[:]
    while waiting:
        children = below.get(waiting.pop(0), [])
        ordered |= {joint.name: joint for joint in children}
        waiting += [joint.child for joint in children]
    if lost := [joint.name for joint in joints.values() if joint.name not in ordered]:
        raise UrdfError(f"has a loop of links at the joints {', '.join(lost)}; a description has trees only")
    return Urdf(name, roots[0], links, ordered, above)


def _name(element: Element) -> str:
    name = element.get("name", "").strip()
    if not name:
        raise UrdfError(f"has a <{element.tag}> without a name")
    return name


def _link(element: Element, folder: Path) -> UrdfLink:
    name = _name(element)
    where = f"link {name}"
    solids, unread = solids_of(element, where, folder)
    return UrdfLink(name, _inertial(element.find("inertial"), where), solids, unread)


def _inertial(element: Element | None, where: str) -> Inertial | None:
    if element is None:
        return None
    mass, tensor = element.find("mass"), element.find("inertia")
    mass_kg = number(mass, "value", where)
    if mass_kg is None:
        return None
    if mass_kg < 0.0:
        raise UrdfError(f"{where}: its mass is {mass_kg:g} kg")
    xx, xy, xz, yy, yz, zz = (number(tensor, f"i{axes}", where) or 0.0 for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Inertial(mass_kg, origin(element, where), moments) if mass_kg > 0.0 else None


def _joint(element: Element) -> UrdfJoint:
    name = _name(element)
    where, kind = f"joint {name}", element.get("type", "")
    if kind not in KINDS:
        raise UrdfError(
            f"{where} is of type {kind!r}: a description has joints that turn (revolute, continuous) and fixed ones;"
            " in a copy of the file make it one of them: a finger that slides may turn instead"
        )
    mimic = element.find("mimic")
    parent, child = (_end(element, tag, where) for tag in ("parent", "child"))
    place = origin(element, where)
    if kind == FIXED:
        return UrdfJoint(name, kind, parent, child, place)
    axis = element.find("axis")
    x, y, z = (1.0, 0.0, 0.0) if axis is None else vector(axis, "xyz", where, (1.0, 0.0, 0.0))
    length = sqrt(x * x + y * y + z * z)
    if length < 1e-9:
        raise UrdfError(f"{where}: its axis has no direction")
    limit = element.find("limit")
    limits = None
    if kind == REVOLUTE:
        low, high = (number(limit, field, where) or 0.0 for field in ("lower", "upper"))
        if low > high:
            raise UrdfError(f"{where}: its limits fall, from {low:g} to {high:g} rad")
        limits = (low, high) if low < high and max(-low, high) < ENDLESS_RAD else None
    return UrdfJoint(
        name, kind, parent, child, place, (x / length, y / length, z / length), limits,
        _positive(limit, "effort", where), _positive(limit, "velocity", where),
        None if mimic is None else mimic.get("joint", ""),
    )  # fmt: skip


def _positive(limit: Element | None, name: str, where: str) -> float | None:
    """A limit's value; None when it is not there or next to 0. Raises UrdfError for a negative one."""
    value = number(limit, name, where)
    if value is not None and value < 0.0:
        raise UrdfError(f"{where}: its {name} is {value:g}")
    return value if value is not None and value > LEAST else None


def _end(element: Element, tag: str, where: str) -> str:
    end = element.find(tag)
    link = "" if end is None else end.get("link", "").strip()
    if not link:
        raise UrdfError(f"{where}: its <{tag}> is missing")
    return link
