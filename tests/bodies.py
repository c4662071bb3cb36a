"""Descriptions of robots that are the Calliope but for one limb."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

DESCRIPTION = resources.files("cocoro").joinpath("calliope.toml").read_text(encoding="utf-8")


def without_table(text: str, name: str) -> str:
    """A description without the table `[name]`."""
    shorter = re.sub(rf"^\[{name}\]\n(?:(?!\[).*\n)*", "", text, flags=re.MULTILINE)
    assert shorter != text
    return shorter


def without_row(text: str, table: str, name: str) -> str:
    """A description without the row of that name in `[[table]]`."""
    shorter = re.sub(rf'^\[\[{table}\]\]\nname = "{name}"\n(?:(?!\[).*\n)*', "", text, flags=re.MULTILINE)
    assert shorter != text
    return shorter


def without_line(text: str, line: str) -> str:
    """A description without the line that begins so."""
    shorter, count = re.subn(rf"^{re.escape(line)}.*\n", "", text, flags=re.MULTILINE)
    assert count == 1
    return shorter


def without_neck(down_deg: float = 28.0) -> str:
    """A Calliope whose camera is fixed where its neck holds it, tilted down."""
    text = without_table(DESCRIPTION, "head")
    for joint in ("neck_pan", "neck_tilt"):
        text = without_line(without_row(text, "joint", joint), f'joint = "{joint}"')
    mount = 'name = "camera_mount"\nparent = "neck_tilt"\ntheta_deg = 90.0'
    assert mount in text
    return text.replace(mount, mount.replace("90.0", f"{90.0 - down_deg}"))


def without_mount_and_marker() -> str:
    """A Calliope with nothing about its camera that the arm must avoid, and no ball on its hand."""
    text = without_table(DESCRIPTION, "marker")
    for field in ("mount_min_m", "mount_max_m", "kinect_min_m", "kinect_max_m", '  ["mount", '):
        text = without_line(text, field)
    return text


JAWS = {"claw_left": (-1.0, 80.0), "claw_right": (1.0, -80.0)}
"""Sign of opening, and the finger's angle, degrees."""
FIXED_FINGER = """
[[link]]
name = "fixed_tip"
parent = "{fixed}"
theta_deg = {turn}
d_m = 0.0
alpha_deg = 0.0
r_m = 0.11

[[hull.tube]]
name = "fixed_finger"
start = "{fixed}"
end = "fixed_tip"
radius_m = 0.02
balls = 3
"""


def with_one_jaw(jaw: str = "claw_left", fixed_pad_m: float = 0.036) -> str:
    """A Calliope whose other claw is fixed, with its pad so far from the hand's axis."""
    (fixed,) = JAWS.keys() - {jaw}
    text = without_line(without_row(DESCRIPTION, "joint", fixed), f'joint = "{fixed}"')
    for line in ("open_sign", "finger_turn_deg"):
        text = without_line(text, line)
    sign, turn = JAWS[jaw]
    text = text.replace("[claw]\n", f"[claw]\nopen_sign = {{ {jaw} = {sign} }}\nfixed_pad_m = {fixed_pad_m}\n")
    text = text.replace("[hull]\n", f"[hull]\nfinger_turn_deg = {{ {jaw} = {turn} }}\n")
    link, tube = FIXED_FINGER.format(fixed=fixed, turn=JAWS[fixed][1]).split("\n[[hull.tube]]")
    text = text.replace("# A ball on the wrist-roll", f"{link}\n# A ball on the wrist-roll")
    return text.replace("[pose.park]", f"[[hull.tube]]{tube}\n[pose.park]")


def written(folder: Path, text: str) -> str:
    """The path of a description's file."""
    file = folder / "body.toml"
    file.write_text(text, encoding="utf-8")
    return str(file)
