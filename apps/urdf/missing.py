"""What a URDF does not say, or what this one does not: for the page beside the description."""

from __future__ import annotations

from math import degrees
from typing import Any, NamedTuple

from apps.urdf.assumed import CAMERA_DOWN_DEG, LIMITS_DEG, LINE, LOAD_KG, SPEED_RADPS, TORQUE_NM, Body, torque_nm
from apps.urdf.hand import Hand
from apps.urdf.model import Urdf
from apps.urdf.parts import ASSUMED_MASS_KG, Parts
from apps.urdf.roles import Roles
from apps.urdf.wheels import RADIUS_M

NEVER, GUESSED, FILE = "What no URDF says", "Guessed from order and names", "What this file lacks"


class Missing(NamedTuple):
    """One thing that is missing, and what stands in its place."""

    section: str
    what: str
    where: str
    """Table and field of the description."""
    now: str
    """What stands there."""
    otherwise: str
    """What happens as long as it stands there."""


def missing_of(
    urdf: Urdf, roles: Roles, hand: Hand, parts: Parts, body: Body, data: dict[str, Any]
) -> tuple[Missing, ...]:
    rows = (*_never(roles, body, data), *_guessed(urdf, roles, hand, body, data), *_lacking(urdf, roles, parts))
    return tuple(sorted(rows, key=lambda row: (NEVER, GUESSED, FILE).index(row.section)))


def _never(roles: Roles, body: Body, data: dict[str, Any]) -> list[Missing]:
    return [
        *_base(roles, body, data),
        Missing(
            NEVER, "time for which a command counts, time to stand still, acceleration", "`[base]`, `[network.*]`",
            "the Calliope's", "the emergency stop keeps its times only if the base can brake so hard",
        ),
        Missing(
            NEVER, "protocol and speed of the servo lines", "`[network.*]`", "`dynamixel`, 1 Mbaud",
            "servos of another protocol do not answer",
        ),
        Missing(
            NEVER, "lines and IDs of the servos", "`[[joint]]` network, id",
            f"all on the line `{LINE}`, IDs counted up in the URDF's order",
            "an order goes to another joint: set them before the servos have power",
        ),
        Missing(
            NEVER, "direction and zero of each servo", "`[[joint]]` direction, centre_count",
            "1, and the middle of the servo's range",
            "a joint turns the wrong way, or its angles are off; `cocoro servos calibrate` measures zeros",
        ),
        Missing(
            NEVER, "picture size, field of view and depth of the camera", "`[[camera]]`", "a Kinect's",
            "what it sees is taken to be elsewhere",
        ),
        Missing(
            NEVER, "postures: folded away, unfolded, hand in front; where the arm reaches", "`[pose.*]`, `[reach]`",
            _postures(data), "the arm may strike itself on its way: set them before it moves",
        ),
        Missing(
            NEVER, "space that arm and hand take up, for keeping them clear", "`[hull]`",
            "balls of 30 mm along the arm from joint to joint", "thicker links touch what the planner keeps clear of",
        ),
        Missing(
            NEVER, "fingers: length, gap, thickness of their pads", "`[claw]`, `[hull] finger_turn_deg`",
            "pads that reach from the jaws' axes to the tip", "the simulated hand grips elsewhere than the real one",
        ),
        Missing(
            NEVER, "the ball on the hand that learning looks at", "`[marker]`", "none",
            "the arm cannot be learned: `cocoro learn` and `babble-arm` are refused",
        ),
        Missing(
            NEVER, "space of the camera and of what holds it up",
            "`[[camera]] mount_min_m`, `mount_max_m`, `[hull] kinect_min_m`, `kinect_max_m`", "none",
            "the planner does not keep the arm off them",
        ),
    ]  # fmt: skip


def _postures(data: dict[str, Any]) -> str:
    if "reach" not in data:
        return (
            "all joints at 0 or amid their limits; parked, turned to a side; a Calliope's reach: with a level hand this"
            " arm does not come clear to the floor"
        )
    low, high = data["reach"]["grasp_radius_range_m"]
    return (
        f"chosen by the arm's kinematics: it grasps {low:g} to {high:g} m from the axis of {data['arm']['joints'][0]}"
    )


def _base(roles: Roles, body: Body, data: dict[str, Any]) -> list[Missing]:
    base, rolling, x_y_z = data["base"], body.rolling, [round(value, 3) for value in body.root.xyz_m]
    of_root = f"`[[link]]` {data['link'][0]['name']}, and the parts of the link `body`"
    if rolling is None:
        wheels = f" The URDF has the wheels {', '.join(roles.wheels)}: in the simulator they are rigid."
        return [
            Missing(
                NEVER, "kind, wheels and limits of the base", "`[base]`",
                f"a differential base, {base['chassis_diameter_m']:g} m wide, its wheels"
                f" {base['wheel_separation_m']:g} m apart, at most {base['max_wheel_speed_mps']:g} m/s."
                + (wheels if roles.wheels else ""),
                "it drives in the simulator; a real one drives other distances than were asked for",
            ),
            Missing(
                NEVER, "where the URDF's root is in the body's frame (on the floor, x ahead, z up, amid the wheels)",
                of_root, f"{x_y_z} m, not turned", "every place that the arm reaches is shifted or turned",
            ),
        ]  # fmt: skip
    turned = "not turned" if not body.root.rpy_rad[2] else f"turned by {degrees(body.root.rpy_rad[2]):.1f} degrees"
    rows = [
        Missing(
            GUESSED, "kind and wheels of the base", "`[base]`",
            f"{base['kind']}, of the joints {', '.join(rolling.joints)}, whose axles are level",
            "it drives other ways than were asked for",
        ),
        Missing(
            GUESSED, "where the URDF's root is in the body's frame, and which way is ahead", of_root,
            f"{x_y_z} m, {turned}: the middle is amid the wheels",
            "every place that the arm reaches is shifted or turned",
        ),
        Missing(
            NEVER, "width and height of the base, its mass with battery and electronics, its top speed, its bumper",
            "`[base]`",
            f"{base['chassis_diameter_m']:g} m and {base['chassis_height_m']:g} m; {base['mass_kg']:g} kg, of which"
            f" {LOAD_KG:g} kg are not the URDF's; {base['max_wheel_speed_mps']:g} m/s; none",
            "it touches what it drives past, or keeps too far off",
        ),
        Missing(
            NEVER, "the way in which each wheel's servo turns it", "`[base]`",
            "forwards is positive about the URDF's axis",
            "the base drives another way than it was told: set it before it stands on the floor",
        ),
    ]  # fmt: skip
    if rolling.guessed:
        what = f"radius of the wheels {', '.join(rolling.guessed)}, which have no shape that could be read"
        where = "`[[base.wheel]] radius_m`" if base["kind"] == "omni" else "`[base] wheel_radius_m`"
        rows.append(Missing(FILE, what, where, f"{RADIUS_M:g} m each", "it drives other distances than were asked for"))
    return rows


def _guessed(urdf: Urdf, roles: Roles, hand: Hand, body: Body, data: dict[str, Any]) -> list[Missing]:
    arm = data["arm"]
    limb = f"{', '.join(arm['joints'])}; bend {arm['bend']}, roll {arm['roll']}"
    rows = [
        Missing(
            GUESSED, "what the arm's joints are for", "`[arm]`", limb,
            "reaching needs the first to turn about the vertical and the roll about the hand's own axis",
        ),
        Missing(
            GUESSED, "the point that goes to a target's centre", "`[arm] tip`",
            f"the link {arm['tip']}" + ("" if hand.tip else ", added: no link of the URDF has z along the hand"),
            "the hand closes beside things",
        ),
    ]  # fmt: skip
    signs = ", ".join(f"{jaw} {'+' if sign > 0 else '-'}" for jaw, sign in hand.open_sign.items())
    rows.append(Missing(GUESSED, "the way in which the jaws open", "`[claw] open_sign`", signs, "it closes to open"))
    if led := [name for name in roles.jaws if urdf.joints[name].mimics is not None]:
        what = f"the servo of {', '.join(led)}, which mimics {urdf.joints[led[0]].mimics}"
        now = "one of its own, as every joint has"
        rows.append(Missing(GUESSED, what, "`[[joint]]`", now, "a real hand with one servo for both does not close"))
    if hand.fixed_pad_m is not None:
        how = "as of the solids beside the tip" if hand.pads_known else "assumed: no solids lie on its two sides alone"
        rows.append(
            Missing(
                GUESSED, "where the fixed finger is, and the gap to the jaw at its angle 0",
                "`[claw] fixed_pad_m`, `pad_gap_m`",
                f"{data['claw']['fixed_pad_m']:g} m and {data['claw']['pad_gap_m']:g} m, {how}",
                "the hand closes beside things, or pushes them",
            )
        )  # fmt: skip
    camera = (
        roles.camera
        or f"none in the URDF: fixed on the body at {[round(value, 3) for value in body.camera_m]} m,"
        f" {CAMERA_DOWN_DEG:g} degrees down"
    )
    where = "`[[camera]] link`" if roles.camera else f"`[[link]]` {data['camera'][0]['link']}"
    rows.append(Missing(GUESSED, "the camera's place", where, camera, "what it sees is taken to be elsewhere"))
    idle = [name for name in roles.joints if name not in (*roles.arm, roles.roll, *roles.jaws, *roles.head)]
    if idle:
        rows.append(Missing(GUESSED, "what these joints are for", "`[arm]`", ", ".join(idle), "they hold still"))
    for doubt in roles.doubts:
        where, _, sentence = doubt.partition(": ")
        so = "its pictures are not used" if where.startswith("[[camera]]") else "reaching goes wrong"
        rows.append(Missing(GUESSED, sentence, f"`{where}`", "as it is", so))
    return rows


def _lacking(urdf: Urdf, roles: Roles, parts: Parts) -> list[Missing]:
    whys: dict[str, list[str]] = {}
    for name, link in urdf.links.items():
        for why, which in link.unread:
            whys.setdefault(why, []).append(f"{name} ({which})")
    rows = [
        Missing(FILE, f"shapes of links ({why}): {', '.join(names)}", "`[solid] part`", "nothing", "things go through")
        for why, names in whys.items()
    ]
    if parts.weightless:
        what, now = f"mass of {', '.join(parts.weightless)}", f"{ASSUMED_MASS_KG:g} kg each"
        rows.append(Missing(FILE, what, "`[solid] part`", now, "servos carry less or more than they will"))
    for field, what, where, now in (
        ("limits_rad", "limits", "limits_deg", f"{LIMITS_DEG[0]:g} to {LIMITS_DEG[1]:g} degrees"),
        ("effort_nm", "torque", "torque_nm", f"{TORQUE_NM:g} N m"),
        ("velocity_radps", "speed", "max_speed_radps", f"{SPEED_RADPS:g} rad/s"),
    ):
        if lacking := [name for name in roles.joints if not getattr(urdf.joints[name], field)]:
            rows.append(
                Missing(
                    FILE, f"{what} of {', '.join(lacking)}", f"`[[joint]] {where}`", now, "the joint is asked for it"
                )
            )
    given = {(urdf.joints[name].effort_nm, urdf.joints[name].velocity_radps) for name in roles.joints}
    if len(given) == 1 and None not in (alike := given.pop()):
        now = f"{torque_nm(alike[0]):g} N m and {alike[1]:g} rad/s for every joint, as of a file that was not filled in"
        now += f", which has {alike[0]:g} N m" if torque_nm(alike[0]) != alike[0] else ""
        fields = "`[[joint]] torque_nm`, `max_speed_radps`"
        rows.append(Missing(FILE, "torque and speed", fields, now, "the simulated servos are stronger or weaker"))
    return rows
