"""Where the hand of a URDF is: the point between its jaws, the way it points, and the frames of its jaws."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from apps.urdf.model import Urdf, UrdfJoint
from apps.urdf.parts import half_m
from apps.urdf.roles import Roles, rigid_with
from apps.urdf.rows import turn_to
from apps.urdf.values import UrdfError
from cocoro.arrays import FloatArray

_AHEAD_M = 0.05
"""From the jaws' axes to the point between them, where the URDF has no link for it."""
_LEAST_REACH_M = 0.01
_LEAST_M = 0.001
_EVEN_RAD = 0.02
"""Limits count as even whose ends differ by less."""
_ALONG = 0.8
"""Least cosine between the z axis of a link and the hand of which it is the tip."""
_ALONG_ONE = 0.995
"""The same for a hand with one jaw, whose fixed pad lies along the roll axis."""
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
    open_sign: dict[str, float]
    """Jaws open towards the farther end of their limits; of a pair whose limits are even, away from the roll axis."""
    fixed_pad_m: float | None
    """With one jaw: distance of the other finger's face from the tip's axis."""
    pads_known: bool
    """Whether that distance and the gap are those of solids."""
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
    least = _ALONG if len(roles.jaws) > 1 else _ALONG_ONE
    if known is not None and float(known[:3, 2] @ along) > least and _is_ahead(known[:3, 3], pivots, along):
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
    signs: dict[str, float] = {}
    only = roles.jaws[0] if len(roles.jaws) == 1 else None
    for jaw in roles.jaws:
        joint = urdf.joints[jaw]
        child = poses[joint.child]
        z = child[:3, :3] @ joint.axis
        pivot = child[:3, 3] + z * float(z @ (point - child[:3, 3]))
        across = along - z * float(z @ along)
        y = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else turn_to(z)[:3, 1]
        offset = float((pivot - palm[:3, 3]) @ np.cross(y, z))
        side = -1.0 if offset < 0.0 else 1.0
        signs[jaw] = _opens(urdf.joints[jaw]) or (1.0 if jaw == only else -side)
        if jaw == only:
            side = -signs[jaw]  # it opens away from the fixed finger, wherever its axis is
        frame = np.eye(4)
        frame[:3, :3] = np.stack((side * np.cross(y, z), side * y, z), axis=1)
        frame[:3, 3] = pivot
        frames[jaw] = np.linalg.inv(child) @ frame
        finger_deg[jaw] = 90.0 * side
        reaches.append(abs(float(y @ (point - pivot))))
        if reaches[-1] < _LEAST_M:
            raise UrdfError(f"joint {jaw} turns no jaw: its axis goes through the point that the hand is to grasp with")
        offsets.append(abs(offset))
    pad_m = min(max(min(reaches, default=_GREATEST_PAD_M), _LEAST_PAD_M), _GREATEST_PAD_M)
    gap_m, fixed_m, known = max(_LEAST_GAP_M, 2.0 * max(offsets, default=0.0)), None, False
    if only is not None:
        outward = (poses[urdf.joints[only].child] @ frames[only])[:3, 0]
        pivot_m = float(((poses[urdf.joints[only].child] @ frames[only])[:3, 3] - point) @ outward)
        gap_m, fixed_m, known = _pads(urdf, roles, point, along, outward, pivot_m)
        frames[roles.roll] = np.linalg.inv(palm) @ _hand_frame(palm, urdf.joints[roles.roll], outward)
    return Hand(tip, place, frames, pad_m, gap_m, signs, fixed_m, known, finger_deg)


def _opens(joint: UrdfJoint) -> float:
    """The sign of the farther end of its limits; 0 where they are even."""
    low, high = joint.limits_rad or (-1.0, 1.0)
    return 0.0 if abs(low + high) < _EVEN_RAD else -1.0 if -low > high else 1.0


def _hand_frame(palm: FloatArray, roll: UrdfJoint, outward: FloatArray) -> FloatArray:
    """The frame (4, 4) in the root's whose z is the roll's axis and whose x is the way that the only jaw opens."""
    z = palm[:3, :3] @ roll.axis
    x = outward - z * float(z @ outward)
    x /= np.linalg.norm(x)
    frame = np.array(palm)
    frame[:3, :3] = np.stack((x, np.cross(z, x), z), axis=1)
    return frame


def _pads(
    urdf: Urdf, roles: Roles, point: FloatArray, along: FloatArray, outward: FloatArray, pivot_m: float
) -> tuple[float, float, bool]:
    """Gap of the pads and the fixed one's distance from the tip's axis, m, with one jaw, and whether both are those of
    solids that the hand and the jaw have on either side of the tip. `pivot_m`: the jaw's axis from there, outward."""
    least_m = max(_LEAST_GAP_M / 2, pivot_m)
    hand = (urdf.joints[roles.roll].child, *rigid_with(urdf, urdf.joints[roles.roll].child))
    moving = (urdf.joints[roles.jaws[0]].child, *rigid_with(urdf, urdf.joints[roles.jaws[0]].child))
    across = [_spans(urdf, links, point, along, outward) for links in (hand, moving)]
    fixed = [-high for low, high in across[0] if high <= 0.0]
    jaw = [low for low, _ in across[1] if low >= 0.0]
    if not fixed or not jaw or len(fixed) < len(across[0]) or len(jaw) < len(across[1]):
        return 2.0 * least_m, least_m, False
    fixed_m, jaw_m = min(fixed), min(jaw)
    if fixed_m + jaw_m < _LEAST_PAD_M / 2 or jaw_m < pivot_m - PAD_THICKNESS_M:
        return 2.0 * least_m, least_m, False
    return fixed_m + jaw_m, fixed_m, True


def _spans(
    urdf: Urdf, links: Iterable[str], point: FloatArray, along: FloatArray, outward: FloatArray
) -> list[tuple[float, float]]:
    """From where to where, outward from the tip's axis, m, those solids of the links go that are beside the tip."""
    poses, spans = urdf.poses(), []
    for link in links:
        for solid in urdf.links[link].solids:
            place = poses[link] @ solid.place
            half = half_m(solid)
            ahead, out = (
                (float(way @ (place[:3, 3] - point)), float(np.abs(way @ place[:3, :3]) @ half))
                for way in (along, outward)
            )
            if abs(ahead[0]) < ahead[1]:
                spans.append((out[0] - out[1], out[0] + out[1]))
    return spans


def _middles(urdf: Urdf, link: str) -> list[FloatArray]:
    """The middles of a link's solids and its centre of mass, in its frame."""
    row = urdf.links[link]
    mass = [] if row.inertial is None else [np.array(row.inertial.place.xyz_m)]
    return [*mass, *(solid.place[:3, 3] for solid in row.solids)]
