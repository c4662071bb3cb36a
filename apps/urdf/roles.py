"""What the joints and links of a URDF are for, as far as their order and their names tell."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from apps.urdf.model import CONTINUOUS, Urdf, UrdfJoint
from apps.urdf.values import UrdfError
from cocoro.arrays import FloatArray

_JAW_JOINT = re.compile(r"jaw|claw|finger|grip|pinc", re.IGNORECASE)
_JAW_LINK = re.compile(r"jaw|claw|finger", re.IGNORECASE)
"""The link that the last joint of an arm rolls is often called the gripper."""
_TIP = re.compile(r"tip|tcp|tool|frame|grasp|(^|_)ee(_|$)|end_?effector", re.IGNORECASE)
_HOLDER = re.compile(r"mount|bracket|holder|mast|base", re.IGNORECASE)
_CAMERA = re.compile(r"cam|kinect|optical", re.IGNORECASE)
_LEAST_ARM = 3
_MOST_JAWS = 2
_PARALLEL = 0.95
"""Least cosine of the angle between two axes that count as parallel."""


@dataclass(frozen=True)
class Roles:
    """Names are the URDF's. What was guessed is in `doubts`, sentences for the page of what is missing."""

    joints: tuple[str, ...]
    """All that turn as joints of the description; wheels are not among them."""
    wheels: tuple[str, ...]
    arm: tuple[str, ...]
    bend: str
    roll: str
    jaws: tuple[str, ...]
    tip: str | None
    """The link that the URDF has for it."""
    camera: str | None
    head: tuple[str, ...]
    """The joints that turn the camera and not the arm."""
    doubts: tuple[str, ...]


def roles_of(urdf: Urdf) -> Roles:
    """Guess them. Raises UrdfError when no joints follow one another as an arm's do."""
    below = {name: _moving_below(urdf, joint) for name, joint in urdf.joints.items() if joint.moves}
    wheels = tuple(
        name
        for name, rest in below.items()
        if urdf.joints[name].kind == CONTINUOUS and not rest and len(urdf.moving(urdf.joints[name].child)) == 1
    )
    joints = tuple(name for name in below if name not in wheels)
    chains = [[joint.name for joint in urdf.moving(urdf.joints[name].child)] for name in joints if not below[name]]
    chains.sort(key=lambda chain: (not any(_is_jaw(urdf.joints[name]) for name in chain), -len(chain)))
    chain = chains[0] if chains else []
    doubts: list[str] = []
    if len(chain) > _LEAST_ARM and _is_jaw(urdf.joints[chain[-1]]):
        chain = chain[:-1]
        while len(chain) > _LEAST_ARM and _JAW_JOINT.search(chain[-1]):
            chain = chain[:-1]
    siblings = [other for other in chains if other[:-1] == chain[:-1] and len(chain) > _LEAST_ARM]
    if not below.get(chain[-1] if chain else "") and len(siblings) > 1:
        chain = chain[:-1]
    if len(chain) < _LEAST_ARM:
        have = f"has {', '.join(chain)}" if chain else "has none"
        raise UrdfError(
            f"has no arm: {_LEAST_ARM} joints that follow one another are the least (two for the arm, one that rolls"
            f" the hand), and the longest chain {have}"
        )
    arm, roll = tuple(chain[:-1]), chain[-1]
    jaws = tuple(sorted(below[roll], key=lambda name: not _is_jaw(urdf.joints[name]))[:_MOST_JAWS])
    if not jaws:
        raise UrdfError(f"has no hand that closes: no joint turns behind {roll}, the last one of its arm")
    if led := [name for name in joints if urdf.joints[name].mimics is not None and name not in jaws]:
        raise UrdfError(
            f"joint {led[0]} mimics {urdf.joints[led[0]].mimics}: in a description each joint has its own servo; in a"
            " copy of the file take out its <mimic>, or make it fixed"
        )
    axes = {name: _axis(urdf, name) for name in chain}
    bends = [two for one, two in pairwise(arm) if abs(float(axes[one] @ axes[two])) > _PARALLEL]
    bend = bends[0] if bends else arm[len(arm) // 2]
    if not bends:
        doubts.append(f"[arm] bend: no joint of the arm is parallel to the one before it; {bend} is in the middle")
    if axes[arm[0]][2] < _PARALLEL:
        doubts.append(
            f"[arm] joints: the first one is to turn the arm about the vertical, counter-clockwise positive as seen"
            f" from above; the axis of {arm[0]} points to {np.round(axes[arm[0]], 2).tolist()} in the body's frame"
        )
    tips = [link for link in rigid_with(urdf, urdf.joints[roll].child) if _TIP.search(link)]
    camera, head = _camera(urdf, set(wheels), set(chain) | set(jaws), doubts)
    return Roles(joints, wheels, arm, bend, roll, jaws, tips[-1] if tips else None, camera, head, tuple(doubts))


def _camera(urdf: Urdf, wheels: set[str], limb: set[str], doubts: list[str]) -> tuple[str | None, tuple[str, ...]]:
    """The link of the camera and the joints above it: one that stands on the body, or that two joints turn as a head's
    do. Those on other joints become doubts."""
    fit = []
    for link in (link for link in urdf.links if _CAMERA.search(link)):
        above = tuple(joint.name for joint in urdf.moving(link) if joint.name not in wheels)
        if len(above) in (0, 2) and not limb & set(above):
            fit.append((link, above))
        else:
            doubts.append(
                f"[[camera]] link: the camera {link} is not used: {', '.join(above)} turn it, which are no head"
            )
    fit.sort(key=lambda one: ("optical" not in one[0].lower(), bool(_HOLDER.search(one[0]))))
    return fit[0] if fit else (None, ())


def _is_jaw(joint: UrdfJoint) -> bool:
    return bool(_JAW_JOINT.search(joint.name) or _JAW_LINK.search(joint.child))


def _moving_below(urdf: Urdf, joint: UrdfJoint) -> list[str]:
    """The joints that turn somewhere behind a joint."""
    found, waiting = [], list(urdf.below(joint.child))
    while waiting:
        one = waiting.pop(0)
        found += [one.name] if one.moves else []
        waiting += urdf.below(one.child)
    return found


def rigid_with(urdf: Urdf, link: str) -> list[str]:
    """The links behind a link that no joint turns against it."""
    found, waiting = [], [link]
    while waiting:
        fixed = [joint.child for joint in urdf.below(waiting.pop(0)) if not joint.moves]
        found += fixed
        waiting += fixed
    return found


def _axis(urdf: Urdf, name: str) -> FloatArray:
    """A joint's axis (3,) in the root's frame, with all joints at 0."""
    joint = urdf.joints[name]
    return np.asarray(urdf.poses()[joint.child][:3, :3] @ joint.axis)
