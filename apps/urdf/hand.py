"""Where the hand of a URDF is: the point between its jaws, the way it points, and the frames of its jaws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apps.urdf.model import Urdf
from apps.urdf.roles import Roles
from apps.urdf.rows import turn_to
from cocoro.arrays import FloatArray

_AHEAD_M = 0.05
"""From the jaws' axes to the point between them, where the URDF has no link for it."""
_LEAST_REACH_M = 0.01
_ALONG = 0.8
"""Least cosine between the z axis of a link and the hand of which it is the tip."""
PAD_THICKNESS_M, PAD_HEIGHT_M = 0.008, 0.02
_LEAST_GAP_M, _LEAST_PAD_M, _GREATEST_PAD_M = 0.04, 0.02, 0.11


@dataclass(frozen=True)
class Hand:
    """Frames are (4, 4), m, with all joints at 0."""

    tip: str | None
    """The URDF's link that is its tip; None: `place`."""
    place: FloatArray
    """The tip in the frame of the link that the roll joint moves. Its z axis points along the hand."""
    jaws: dict[str, FloatArray]
    """By jaw, the frame in the URDF's child about whose z it turns: z is the joint's axis, x points away from the roll
    axis, y lies along the hand, and the tip is at z = 0."""
    pad_length_m: float
    pad_gap_m: float
    finger_deg: dict[str, float]
    """By jaw, the angle in its x-y plane from x to its finger."""


def hand_of(urdf: Urdf, roles: Roles) -> Hand:
    poses = urdf.poses()
    roll = urdf.joints[roles.roll]
    palm = poses[roll.child]
    to_palm = np.linalg.inv(palm)
    pivots = [(to_palm @ poses[urdf.joints[jaw].child])[:3, 3] for jaw in roles.jaws]
    axis = np.array(roll.axis)
    known = None if roles.tip is None else to_palm @ poses[roles.tip]
    ahead = [*pivots, *([] if known is None else [known[:3, 3]])] or _middles(urdf, roll.child)
    along = -axis if sum(float(axis @ point) for point in ahead) < 0.0 else axis
    farthest = max((float(along @ pivot) for pivot in pivots), default=0.0)
    if known is not None and float(known[:3, 2] @ along) > _ALONG and _is_ahead(known[:3, 3], pivots, along):
        return _with_jaws(urdf, roles, roles.tip, known)
    place = turn_to(along)
    if known is not None and _is_ahead(known[:3, 3], pivots, along):
        place[:3, 3] = known[:3, 3]
    else:
        place[:3, 3] = along * (farthest + _AHEAD_M)
    return _with_jaws(urdf, roles, None, place)


def _is_ahead(point: FloatArray, pivots: list[FloatArray], along: FloatArray) -> bool:
    return all(float(along @ (point - pivot)) > _LEAST_REACH_M for pivot in pivots)


def _with_jaws(urdf: Urdf, roles: Roles, tip: str | None, place: FloatArray) -> Hand:
    poses = urdf.poses()
    palm = poses[urdf.joints[roles.roll].child]
    point, along = (palm @ place)[:3, 3], (palm @ place)[:3, 2]
    frames, finger_deg, reaches, offsets = {}, {}, [], []
    for jaw in roles.jaws:
        joint = urdf.joints[jaw]
        child = poses[joint.child]
        z = child[:3, :3] @ joint.axis
        pivot = child[:3, 3] + z * float(z @ (point - child[:3, 3]))
        across = along - z * float(z @ along)
        y = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else turn_to(z)[:3, 1]
        offset = float((pivot - palm[:3, 3]) @ np.cross(y, z))
        side = -1.0 if offset < 0.0 else 1.0
        frame = np.eye(4)
        frame[:3, :3] = np.stack((side * np.cross(y, z), side * y, z), axis=1)
        frame[:3, 3] = pivot
        frames[jaw] = np.linalg.inv(child) @ frame
        finger_deg[jaw] = 90.0 * side
        reaches.append(abs(float(y @ (point - pivot))))
        offsets.append(abs(offset))
    pad_m = min(max(min(reaches, default=_GREATEST_PAD_M), _LEAST_PAD_M), _GREATEST_PAD_M)
    return Hand(tip, place, frames, pad_m, max(_LEAST_GAP_M, 2.0 * max(offsets, default=0.0)), finger_deg)


def _middles(urdf: Urdf, link: str) -> list[FloatArray]:
    """The middles of a link's solids and its centre of mass, in its frame."""
    row = urdf.links[link]
    mass = [] if row.inertial is None else [np.array(row.inertial.place.xyz_m)]
    return [*mass, *(solid.place[:3, 3] for solid in row.solids)]
