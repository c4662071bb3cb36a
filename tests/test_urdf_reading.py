"""Reading a URDF: what is read, and what is refused, with its file and element."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from urdf_rig import DESK_ARM, desk_arm

from apps.urdf import stl
from apps.urdf.reading import read
from cocoro.errors import ConfigError

LINKS = '<link name="a"/><link name="b"/><link name="c"/>'


def joint(name: str, parent: str, child: str, more: str = "", kind: str = "revolute") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{more}</joint>'


def robot(inside: str) -> str:
    return f'<robot name="r">{inside}</robot>'


PAIR = joint("p", "a", "b", '<axis xyz="0 0 2"/>') + joint("q", "b", "c")


def test_links_joints_masses_and_shapes_are_read(tmp_path: Path) -> None:
    urdf = read(desk_arm(tmp_path))
    assert urdf.root == "foot"
    parents_first = ["swivel", "lift", "bend", "tilt", "spin", "to_camera", "to_grasp", "left", "right"]
    assert list(urdf.joints) == parents_first
    tilt = urdf.joints["tilt"]
    assert tilt.axis == pytest.approx(np.array([1, -2, 0.5]) / np.sqrt(5.25))
    assert (tilt.limits_rad, tilt.effort_nm, tilt.velocity_radps) == ((-2.0, 1.8), 3.0, 4.0)
    assert urdf.joints["left"].effort_nm is None
    upper = urdf.links["upper"]
    assert upper.inertial is not None
    assert (upper.inertial.mass_kg, upper.inertial.place.rpy_rad) == (0.4, (0.0, 0.0, 0.3))
    mesh = urdf.links["lower"].solids[0]
    assert mesh.shape == "box"
    assert mesh.size_m == pytest.approx((0.04, 0.05, 0.17))
    assert mesh.place[:3, 3] == pytest.approx([0, 0, 0.085])


def test_an_axis_that_is_not_given_is_x_as_the_format_says(tmp_path: Path) -> None:
    urdf = read(desk_arm(tmp_path, robot(LINKS + PAIR)))
    assert (urdf.joints["p"].axis, urdf.joints["q"].axis) == ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("arm: 3", "is not XML"),
        ("", "is not XML"),
        ("<robot><link name='a'></robot>", "is not XML: mismatched tag"),
        ("<?xml version='1.0' encoding='klingon'?><robot/>", "is not XML"),
        ('<!DOCTYPE r [<!ENTITY a "aaaa">]><robot>&a;</robot>', "document type declaration"),
        ("<sdf/>", "is no URDF: its outermost element is <sdf>"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro/></robot>', "is a xacro"),
        (robot(""), "has no links"),
        (robot("<link/>"), "has a <link> without a name"),
        (robot('<link name="a"/><link name="a"/>'), "link a is there twice"),
        (robot(LINKS + PAIR + joint("p", "a", "c")), "joint p is there twice"),
        (robot(LINKS + joint("p", "a", "b")), "has 2 roots, links without a joint above them: a, c"),
        (robot(LINKS + joint("p", "z", "b")), "joint p: its parent 'z' is not a link"),
        (robot(LINKS + joint("p", "a", "z")), "joint p: its child 'z' is not a link"),
        (robot(LINKS + PAIR + joint("r", "a", "c")), "link c is the child of two joints, q and r"),
        (robot(LINKS + joint("p", "b", "c") + joint("q", "c", "b")), "has a loop of links at the joints p, q"),
        (robot('<link name="a"/>' + joint("p", "a", "a")), "has a loop of links at the joints p"),
        (robot(LINKS + joint("p", "a", "b", kind="prismatic")), "joint p is of type 'prismatic'"),
        (robot(LINKS + '<joint name="p" type="fixed"><parent link="a"/></joint>'), "joint p: its <child> is missing"),
        (robot(LINKS + PAIR.replace("0 0 2", "0 0 0")), "joint p: its axis has no direction"),
        (robot(LINKS + PAIR.replace("0 0 2", "0 up 2")), "joint p: xyz='up' of <axis> is not a number"),
        (robot(LINKS + PAIR.replace("0 0 2", "0 2")), "joint p: xyz='0 2' of <axis> is not three numbers"),
        (robot(LINKS + PAIR.replace("0 0 2", "0 0 nan")), "joint p: xyz='nan' of <axis> is not a number"),
        (robot(LINKS + joint("p", "a", "b", '<limit lower="1" upper="-1"/>')), "joint p: its limits fall"),
        (robot('<link name="a"><inertial><mass value="-1"/></inertial></link>'), "link a: its mass is -1 kg"),
        (robot('<link name="a"><collision/></link>'), "link a: a <collision> has no <geometry>"),
        (
            robot('<link name="a"><collision><geometry><box size="1 0 1"/></geometry></collision></link>'),
            "link a: a <box> of its <collision> has a size that is missing or not positive",
        ),
    ],
)
def test_a_file_that_no_description_can_be_made_of_is_refused_with_the_place(
    tmp_path: Path, text: str, says: str
) -> None:
    path = desk_arm(tmp_path, text)
    with pytest.raises(ConfigError, match=re.escape(f"{path}: ") + ".*" + re.escape(says)):
        read(path)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.urdf"):
        with pytest.raises(ConfigError, match=f"{re.escape(str(path))}: cannot be read"):
            read(path)


@pytest.mark.parametrize(
    ("mesh", "why"),
    [
        (None, "its mesh is not there"),
        (b"solid nothing\nendsolid nothing\n", "its mesh has no triangles that could be read"),
        (b"\x00" * 90, "its mesh has no triangles that could be read"),
        (b"vertex 0 0 1e30", "its mesh has no triangles that could be read"),
        (b"vertex 0 0 up", "its mesh has no triangles that could be read"),
    ],
)
def test_a_mesh_that_cannot_be_read_is_listed(tmp_path: Path, mesh: bytes | None, why: str) -> None:
    path = desk_arm(tmp_path, mesh=False)
    if mesh is not None:
        (tmp_path / "lower.stl").write_bytes(mesh)
    link = read(path).links["lower"]
    assert link.solids == ()
    assert link.unread == ((why, "lower.stl"),)


def test_a_mesh_of_another_format_or_a_name_that_no_file_can_have_is_listed(tmp_path: Path) -> None:
    (tmp_path / "lower.dae").touch()
    assert read(desk_arm(tmp_path, DESK_ARM.replace("lower.stl", "lower.dae"))).links["lower"].unread[0][0] == (
        "its mesh is no STL file"
    )
    assert read(desk_arm(tmp_path, DESK_ARM.replace("lower.stl", "l" * 400))).links["lower"].unread[0][0] == (
        "its mesh is not there"
    )


def test_a_mesh_of_a_package_is_found_above_the_file(tmp_path: Path) -> None:
    (tmp_path / "urdf").mkdir()
    desk_arm(tmp_path)
    path = desk_arm(
        tmp_path / "urdf", DESK_ARM.replace("lower.stl", "package://desk_description/lower.stl"), mesh=False
    )
    assert len(read(path).links["lower"].solids) == 1


def test_an_stl_of_text_has_the_bounds_of_its_corners(tmp_path: Path) -> None:
    facet = "facet normal 0 0 1\n outer loop\n  vertex 1 2 3\n  vertex -1 5e-1 0\n  vertex 0 0 9\n endloop\nendfacet\n"
    (tmp_path / "one.stl").write_text(f"solid one\n{facet}endsolid one\n")
    low, high = stl.bounds(tmp_path / "one.stl")
    assert (low.tolist(), high.tolist()) == ([-1.0, 0.0, 0.0], [1.0, 2.0, 9.0])
