"""The solid shapes of a URDF's link: primitives as they are, and a box about each mesh."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from apps.urdf import stl
from apps.urdf.model import Solid
from apps.urdf.values import UrdfError, number, origin, vector
from cocoro.arrays import FloatArray

LEAST_M = 0.001
"""Least side of the box about a mesh, which may be flat."""
PACKAGE, FILE = "package://", "file://"
_LEVELS = 3
"""A package's folder is looked for so many folders above the URDF's."""


def solids_of(link: Element, where: str, folder: Path) -> tuple[tuple[Solid, ...], tuple[tuple[str, str], ...]]:
    """The shapes of a link's `<collision>` elements, and for each that could not be read why, and which. Raises
    UrdfError for a primitive without its sizes."""
    solids: list[Solid] = []
    unread: list[tuple[str, str]] = []
    for element in link.findall("collision"):
        geometry = element.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        place = origin(element, where).transform()
        if shape is None:
            raise UrdfError(f"{where}: a <collision> has no <geometry>")
        if shape.tag == "mesh":
            box = _box_about(shape, place, where, folder)
            if isinstance(box, str):
                unread.append((box, mesh_name(shape)))
            else:
                solids.append(box)
        elif shape.tag in ("box", "cylinder", "sphere"):
            solids.append(Solid(shape.tag, _sizes(shape, where), place))
        else:
            unread.append(("a description has no such shape", shape.tag))
    return tuple(solids), tuple(unread)


def _sizes(shape: Element, where: str) -> tuple[float, ...]:
    if shape.tag == "box":
        sizes: tuple[float | None, ...] = vector(shape, "size", where, (0.0, 0.0, 0.0))
    else:
        sizes = tuple(
            number(shape, name, where) for name in ("radius", "length")[: 2 if shape.tag == "cylinder" else 1]
        )
    found = tuple(size for size in sizes if size is not None and size > 0.0)
    if len(found) < len(sizes):
        raise UrdfError(f"{where}: a <{shape.tag}> of its <collision> has a size that is missing or not positive")
    return found


def _box_about(mesh: Element, place: FloatArray, where: str, folder: Path) -> Solid | str:
    path = _found(mesh_name(mesh), folder)
    if path is None:
        return "its mesh is not there"
    if path.suffix.lower() != ".stl":
        return "its mesh is no STL file"
    try:
        low, high = stl.bounds(path)
    except OSError as error:
        return f"its mesh cannot be read ({error.strerror})"
    except ValueError:
        return "its mesh has no triangles that could be read"
    scale = np.array(vector(mesh, "scale", where, (1.0, 1.0, 1.0)))
    corners = np.sort(np.stack((low * scale, high * scale)), axis=0)
    centre = np.eye(4)
    centre[:3, 3] = corners.mean(axis=0)
    sides = np.maximum(corners[1] - corners[0], LEAST_M)
    return Solid("box", tuple(sides.tolist()), place @ centre)


def mesh_name(mesh: Element) -> str:
    return mesh.get("filename", "")


def _found(name: str, folder: Path) -> Path | None:
    """A mesh's file: as it is named, or, of a package, below a folder above the URDF that has it."""
    if name.startswith(PACKAGE):
        inside = Path(name.removeprefix(PACKAGE))
        without = Path(*inside.parts[1:])
        above = (folder, *list(folder.resolve().parents)[:_LEVELS])
        tried = [place / path for place in above for path in (inside, without)]
    else:
        tried = [folder / name.removeprefix(FILE)]
    return next((path for path in tried if _is_file(path)), None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no file can have
        return False
