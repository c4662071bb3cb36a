"""What `cocoro doctor` says of the cockpit, and what a site's plan gives it."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import msgspec
import pytest
from test_cockpit_tls import Lab

from cocoro.robot import Robot
from deploy.site import plan
from services.cockpit.checks import check
from services.cockpit.config import CockpitConfig


def said(robot: Robot, **given: Any) -> dict[str, tuple[str, str]]:
    """The lines, by their names."""
    return {row.name: (row.state, row.text) for row in check(msgspec.convert(given, CockpitConfig), robot, "calliope")}


@pytest.mark.usefixtures("root")
def test_a_cockpit_for_this_machine_is_well(robot: Robot) -> None:
    lines = said(robot, port=0)
    assert {state for state, _ in lines.values()} == {"ok"}
    assert "this machine's user alone" in lines["cockpit"][1]


@pytest.mark.usefixtures("root")
def test_a_taken_port_and_an_open_cockpit_without_tls_are_named(robot: Robot) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        state, text = said(robot, port=port)["cockpit"]
    assert state == "note"
    assert str(port) in text
    state, text = said(robot, host="0.0.0.0")["cockpit"]
    assert state == "bad"
    assert "TLS" in text


@pytest.mark.usefixtures("root")
def test_a_site_and_its_certificates_are_looked_at(robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    lab, other = Lab(tmp_path / "one"), Lab(tmp_path / "two")
    given = {"host": "127.0.0.1", "port": 0, "credentials": str(lab.of("body"))}
    assert {state for state, _ in said(robot, **given, site=str(lab.folder)).values()} == {"ok"}
    assert said(robot, **given, site=str(other.folder))["cockpit's site"][0] == "bad"
    assert said(robot, **given, site=str(tmp_path))["cockpit's site"][0] == "bad"
    (lab.of("body") / "key.pem").chmod(0o644)
    assert "chmod 600" in said(robot, **given)["cockpit"][1]


def test_a_sites_host_whose_cockpit_is_open_shows_its_certificate(tmp_path: Path) -> None:
    text = """
name = "lab"
[robot.calliope]
profile = "robot.toml"
[host.body]
role = "robot"
processes = ["base", "servos", "kinect", "perception", "planning", "executive", "capture", "cockpit"]
listen = ["tls/10.77.0.1:7447"]
"""
    (tmp_path / "site.toml").write_text(text)
    ours = (Path(plan.__file__).parents[1] / "profiles/robot.toml").read_text()
    for host, opened in (("127.0.0.1", False), ("0.0.0.0", True)):
        profile = f'{ours}\n[service.cockpit]\nhost = "{host}"\n'
        (tmp_path / "robot.toml").write_text(profile)
        found = plan.read(tmp_path).share_profile("body").service["cockpit"]
        assert ("credentials" in found, "site" in found) == (opened, opened)
        if opened:
            assert found["credentials"] == str(tmp_path / "credentials" / "body")
