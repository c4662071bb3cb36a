"""Contradictions within a robot description, besides names that it does not have. Each check raises ValueError."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from cocoro.joints import Network, ServoPlace
from cocoro.units import Vec3


def check_camera(camera: str, links: Mapping[str, tuple[str, str | None]], head: set[str]) -> None:
    """Refuses a camera that other joints turn than the head's, or that one of these does not turn. `links`: parent and
    joint of each by its name."""
    turning, name = set(), camera
    while name in links:
        name, joint = links[name]
        if joint is not None:
            turning.add(joint)
    if others := sorted(turning - head):
        what = "which is none of the head's" if head else "but there is no [head]"
        raise ValueError(f"camera: the joint {others[0]!r} turns it, {what}")
    if idle := sorted(head - turning):
        raise ValueError(f"head: the joint {idle[0]!r} does not turn the camera")


def check_masses(links: Mapping[str, tuple[str, str | None]], massive: Iterable[str], jaws: Iterable[str]) -> None:
    """Refuses a link that a joint turns and that carries no mass: nothing can be computed of how it moves. `links`:
    parent and joint of each by its name; `massive`: those with parts that have a mass; `jaws`: the joints of the claw,
    whose pads have theirs."""
    carrying = set()
    for link in massive:
        while link in links and links[link][1] is None:
            link = links[link][0]
        carrying.add(link)
    for name, (_, joint) in links.items():
        if joint is not None and joint not in jaws and name not in carrying:
            raise ValueError(f"solid.part: the joint {joint!r} turns the link {name!r}, and no part there has a mass")


def check_box(where: str, low_m: Vec3 | None, high_m: Vec3 | None) -> None:
    """Refuses a box with one corner, or whose corners are swapped. `where`: the field of the first one."""
    if low_m is None or high_m is None:
        if low_m != high_m:
            raise ValueError(f"{where}: a box has two corners, and one of them is missing")
    elif not all(low < high for low, high in zip(low_m, high_m, strict=True)):
        raise ValueError(f"{where}: {low_m} must be below {high_m} along each axis")


def check_names(kind: str, names: Iterable[str]) -> None:
    """Refuses a name that two rows of a kind have."""
    known = set()
    for name in names:
        if name in known:
            raise ValueError(f"{kind}: {name!r} is the name of two")
        known.add(name)


def check_claw(jaws: int, fixed_pad_m: float | None) -> None:
    """Refuses a claw of another number of jaws than one or two, and a fixed pad where both fingers move or none where
    one of them is fixed."""
    if not 1 <= jaws <= 2:
        raise ValueError(f"claw.open_sign: a claw has one joint or two, not {jaws}")
    if jaws == 1 and fixed_pad_m is None:
        raise ValueError("claw: with one joint the other finger is fixed, and fixed_pad_m says where: it is missing")
    if jaws == 2 and fixed_pad_m is not None:
        raise ValueError("claw.fixed_pad_m: with two joints no finger is fixed")


def check_poses(poses: Mapping[str, Mapping[str, float]], arm: tuple[str, ...]) -> None:
    """Refuses poses without a joint of the arm that they need."""
    for name, wanted in (("park", arm), ("upright", arm), ("unfolded", arm[1:])):
        if missing := [joint for joint in wanted if joint not in poses.get(name, {})]:
            raise ValueError(f"pose {name}: the angle of {missing[0]!r} is missing")


def check_wheels(servos: Sequence[ServoPlace], networks: Mapping[str, Network]) -> None:
    """Refuses servos of wheels that are on several lines, since they turn together, and those whose positions do not
    run on over a whole turn."""
    if len({one.network for one in servos}) > 1:
        raise ValueError(
            f"the servos of the wheels are on several networks: {', '.join(one.network for one in servos)}"
        )
    for one in servos:
        if (protocol := networks[one.network].protocol) != "feetech":
            raise ValueError(f"wheel {one.name}: no wheel is driven by a servo that speaks {protocol}")
