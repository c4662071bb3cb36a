"""The rows of a description's `solid.part` from the shapes and masses of a URDF.

Of what moves, mass, its centre and the moments of inertia about the link's axes are those of the URDF: a box that
touches nothing has them. Products of inertia are left out. On the body, which stands on the floor, a link's solids
share its mass by their volumes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations, product
from typing import Any

import numpy as np

from apps.urdf.model import Inertial, Solid, Urdf
from apps.urdf.rows import BODY, Rows, rounded
from cocoro.arrays import FloatArray
from cocoro.kinematics import Origin

ASSUMED_MASS_KG = 0.05
"""Of what moves and has no mass in the URDF."""
_ALIGNED = 1e-3
"""Greatest sine between an axis of a shape and one of its link that count as the same."""
_LEAST_KG = 1e-6
_LEAST_SIDE_M, _GREATEST_SIDE_M = 0.002, 1.0


class Parts:
    """The parts, pairs of links that touch at angle 0, and the links whose mass is assumed."""

    def __init__(self, urdf: Urdf, rows: Rows, root: Origin, wheels: Iterable[str], rolling: Iterable[str]) -> None:
        """`rows` gets another for each shape that lies aslant in its link. The links of `wheels` do not collide; those
        of `rolling`, the joints of `[base]`, become no parts, but their mass counts."""
        self.data: list[dict[str, Any]] = []
        self.weightless: list[str] = []
        self.boxes: dict[str, list[FloatArray]] = {}
        """By link that can collide, the corners (2, 3), body frame, m, of the boxes about its solids at angle 0."""
        self._rows = rows
        still = {urdf.joints[wheel].child for wheel in wheels}
        made = {urdf.joints[wheel].child for wheel in rolling}
        poses = {name: root.transform() @ pose for name, pose in urdf.poses().items()}
        carrier = carriers(urdf, rows)
        mass_kg = dict.fromkeys(carrier.values(), 0.0)
        for name, link in urdf.links.items():
            on_body = carrier[name] == BODY
            kg = 0.0 if link.inertial is None or link.inertial.mass_kg < _LEAST_KG else link.inertial.mass_kg
            if name in made:
                mass_kg[BODY] += kg
                continue
            for solid in link.solids:
                place = poses[name] @ solid.place
                if on_body:
                    volume_m3 = sum(one.volume_m3 for one in link.solids)  # 0 of what is too small for its cube
                    share = solid.volume_m3 / volume_m3 if volume_m3 else 1.0 / len(link.solids)
                    mass = rounded((kg or ASSUMED_MASS_KG) * share)
                    part = self._on_body(name, solid, place, {"mass_kg": mass, "solid": name not in still})
                else:
                    self._add(name, rows.link[name], solid, solid.place)
                    part = carrier[name]
                self.boxes.setdefault(part, []).append(_corners(solid, place))
            mass_kg[carrier[name]] += kg
            if link.inertial is not None and kg and not (on_body and link.solids):
                self._add_mass(name, link.inertial, poses[name] if on_body else None)
            elif on_body and link.solids and not kg:
                self.weightless.append(name)
        for moved, kg in mass_kg.items():
            if kg < _LEAST_KG and moved != BODY:
                self.weightless.append(moved)
                self._box(rows.free(f"{moved}_mass"), moved, (0.02, 0.02, 0.02), np.zeros(3), ASSUMED_MASS_KG)
        self.mass_kg = sum(mass_kg.values()) + ASSUMED_MASS_KG * len(self.weightless)

    def touching(self, above: Mapping[str, str]) -> list[tuple[str, str]]:
        """Pairs of links whose boxes overlap at angle 0 though no joint is between them. `above`: by link that a joint
        turns, the one that carries it."""
        fixed = self.boxes.keys() - above.keys()
        return [
            (one, other)
            for one, other in combinations(self.boxes, 2)
            if not {one, other} <= fixed and above.get(one) != other and above.get(other) != one
            if any(_overlap(a, b) for a in self.boxes[one] for b in self.boxes[other])
        ]

    def _on_body(self, link: str, solid: Solid, place: FloatArray, more: dict[str, Any]) -> str:
        """A part of the body, which has no row of its own: aslant, it becomes the box about it, along the body's
        axes."""
        if _aligned(place) is None:
            corners = _corners(solid, place)
            sides, centre = corners[1] - corners[0], np.eye(4)
            centre[:3, 3] = corners.mean(axis=0)
            return self._add(link, BODY, Solid("box", tuple(sides.tolist()), centre), centre, more)
        return self._add(link, BODY, solid, place, more)

    def _add(self, link: str, row: str, solid: Solid, place: FloatArray, more: dict[str, Any] | None = None) -> str:
        axes = _aligned(place) if solid.shape != "sphere" else np.eye(3)
        if axes is None:
            row = self._rows.add(self._rows.free(f"{link}_aslant"), row, Origin.of(place))
            axes, place = np.eye(3), np.eye(4)
        name = self._rows.free(f"{link}_part")
        part = {"name": name, "link": row, "shape": solid.shape, "size_m": [_size(size) for size in solid.size_m]}
        if solid.shape == "box":
            part["size_m"] = [_size(size) for size in np.abs(axes) @ solid.size_m]
        if solid.shape == "cylinder" and (axis := "xyz"[int(np.argmax(np.abs(axes[:, 2])))]) != "z":
            part["axis"] = axis
        if place[:3, 3].any():
            part["position_m"] = [rounded(value, 6) for value in place[:3, 3]]
        self.data.append(part | (more or {}))
        return name

    def _add_mass(self, link: str, inertial: Inertial, pose: FloatArray | None) -> None:
        """The box of the link's mass; with `pose` (4, 4), of a link on the body, in the body's frame."""
        place = inertial.place.transform()
        row = self._rows.link[link] if pose is None else BODY
        place = place if pose is None else pose @ place
        turn = place[:3, :3]
        about = np.diag(turn @ inertial.moments @ turn.T)
        squares = 6.0 / inertial.mass_kg * (about.sum() - 2.0 * about)
        sides = np.clip(np.sqrt(np.maximum(squares, 0.0)), _LEAST_SIDE_M, _GREATEST_SIDE_M)
        self._box(self._rows.free(f"{link}_mass"), row, sides, place[:3, 3], inertial.mass_kg)

    def _box(self, name: str, row: str, sides_m: Iterable[float], centre_m: FloatArray, mass_kg: float) -> None:
        part: dict[str, Any] = {"name": name, "link": row, "shape": "box"}
        part["size_m"] = [rounded(side, 6) for side in sides_m]
        part["position_m"] = [rounded(value, 6) for value in centre_m]
        self.data.append(part | {"mass_kg": rounded(mass_kg), "solid": False})


def carriers(urdf: Urdf, rows: Rows) -> dict[str, str]:
    """By the URDF's link, the row of the joint that moves it; `body` for one that stands still on the body."""
    found = {urdf.root: BODY}
    for joint in urdf.joints.values():
        found[joint.child] = rows.joint.get(joint.name, found[joint.parent])
    return found


def _aligned(place: FloatArray) -> FloatArray | None:
    """The turn (3, 3) of a shape whose axes lie along those of its link, in whatever order; None of one aslant."""
    nearest: FloatArray = np.rint(place[:3, :3])
    return nearest if np.abs(place[:3, :3] - nearest).max() < _ALIGNED else None


def _corners(solid: Solid, place: FloatArray) -> FloatArray:
    """The least and the greatest corner (2, 3), m, of the box about a shape along the axes that `place` leads to."""
    half = half_m(solid)
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    points = (signs * half) @ place[:3, :3].T + place[:3, 3]
    return np.stack((points.min(axis=0), points.max(axis=0)))


def half_m(solid: Solid) -> FloatArray:
    """Half the sides (3,), m, of the box about a shape, along the shape's axes."""
    if solid.shape == "box":
        return np.array(solid.size_m) / 2
    radius = solid.size_m[0]
    return np.array((radius, radius, radius if solid.shape == "sphere" else solid.size_m[1] / 2))


def _size(size_m: float) -> float:
    return max(rounded(size_m, 6), 1e-6)


def _overlap(one: FloatArray, other: FloatArray) -> bool:
    return bool((one[0] < other[1]).all() and (other[0] < one[1]).all())


def lowest_m(urdf: Urdf, links: Iterable[str]) -> float | None:
    """Height of the lowest point of the links' solids in the root's frame, m, at angle 0; None without solids."""
    poses = urdf.poses()
    heights = [float(_corners(s, poses[name] @ s.place)[0, 2]) for name in links for s in urdf.links[name].solids]
    return min(heights, default=None)
