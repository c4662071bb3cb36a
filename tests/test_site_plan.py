"""A site's plan: what it says, what it fills in, and what it refuses with what sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from site_rig import HALL, LAB

from cocoro.errors import ConfigError
from deploy.site import plan


def read(folder: Path, text: str = LAB) -> plan.Site:
    (folder / "site.toml").write_text(text, encoding="utf-8")
    return plan.read(folder)


def test_the_plan_of_the_documentation_can_be_read(tmp_path: Path) -> None:
    assert plan.__doc__ is not None
    text = plan.__doc__.partition("\n\n")[2].partition("\n\nA host connects")[0]
    site = read(tmp_path, text)
    assert (site.name, [*site.hosts], [*site.persons]) == ("lab", ["body", "brain"], ["ada"])


def test_a_host_connects_to_all_that_listen_and_a_person_to_those_of_his_robots(tmp_path: Path) -> None:
    site = read(tmp_path)
    assert site.connects("brain") == ("body",)
    assert site.connects("body") == ()
    assert site.connects("ada") == ("body",)
    assert site.endpoints("ada") == ("tls/10.77.0.1:7447",)


def test_of_two_hosts_that_listen_the_later_one_connects(tmp_path: Path) -> None:
    site = read(tmp_path, LAB.replace('role = "brain"', 'role = "brain"\nlisten = ["tls/10.77.0.2:7447"]'))
    assert (site.connects("body"), site.connects("brain")) == ((), ("body",))


def test_a_share_is_the_robots_profile_with_the_processes_of_one_host_and_its_gateway(tmp_path: Path) -> None:
    site = read(tmp_path)
    share = site.share_profile("brain", ["service.planning.latency_s=0.5"])
    assert share.processes == ("perception", "planning", "executive", "gateway-brain", "frames-brain")
    assert share.service["gateway"] == {"site": str(tmp_path), "host": "brain"}
    assert share.service["planning"]["latency_s"] == 0.5
    assert share.clock == "sim"
    assert "gateway-brain" in share.services()


def test_the_first_host_of_the_robot_s_hardware_keeps_its_time(tmp_path: Path) -> None:
    assert [read(tmp_path).keeper(host) for host in ("body", "brain")] == ["body", "body"]


def test_a_share_s_gateway_has_the_profile_s_settings(tmp_path: Path) -> None:
    share = read(tmp_path).share_profile("brain", ["service.gateway.clock_limit_ms=10.0"])
    assert share.service["gateway"] == {"site": str(tmp_path), "host": "brain", "clock_limit_ms": 10.0}


def test_two_robots_of_a_site_have_hosts_of_their_own(tmp_path: Path) -> None:
    text = """
name = "hall"
[robot.a]
profile = "sim"
[robot.b]
profile = "sim"
[host.one]
role = "robot"
robot = "a"
processes = ["capture", "sim", "perception", "planning", "executive"]
listen = ["tls/10.77.0.1:7447"]
[host.two]
role = "robot"
robot = "b"
processes = ["capture", "sim", "perception", "planning", "executive"]
listen = ["tls/10.77.0.2:7447"]
[person.ada]
role = "operator"
[person.bo]
role = "viewer"
robots = ["b"]
"""
    site = read(tmp_path, text)
    assert site.robots_of("ada") == ("a", "b")
    assert site.connects("bo") == ("two",)
    assert site.connects("two") == (), "hosts of different robots have nothing to say to each other"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (('role = "brain"', 'role = "boss"'), r"\[host\.brain\] role: unknown value 'boss'; known are robot, brain"),
        (("10.77.0.1:7447", "10.77.0.1"), "an endpoint is written as tls/ADDRESS:PORT"),
        (("tls/10.77.0.1:7447", "tcp/10.77.0.1:7447"), "an endpoint is written as tls/ADDRESS:PORT"),
        (("7447", "77447"), "no port between 1 and 65535"),
        (('"planning", ', ""), "process planning runs on no host; give it to one host's processes"),
        (('"capture", "sim"', '"capture", "sim", "planning"'), "process planning runs on body and on brain"),
        (('"capture", "sim"', '"capture", "sim", "kinect"'), "kinect is none of profile sim's"),
        (('"capture", "sim"', '"capture", "simm"'), "there is no process 'simm'"),
        (('role = "robot"', 'role = "brain"'), "sim drives arm, so its host has role 'robot'"),
        (('listen = ["tls/10.77.0.1:7447"]', ""), "brain and body are not connected: let one of them listen"),
        (('role = "brain"', 'role = "brain"\nconnect = ["boddy"]'), "no other host 'boddy'; .*did you mean body"),
        (('role = "brain"', 'role = "brain"\nconnect = ["brain"]'), "no other host 'brain'"),
        (("[person.ada]", "[person.brain]"), "brain is a host and a person"),
        (("[person.ada]", "[person.planning]"), "a service has this name"),
        (('role = "viewer"', 'role = "viewer"\nrobots = ["caliope"]'), "no robot 'caliope'; .*did you mean calliope"),
        (('profile = "sim"', 'profile = "simm"'), "there is no profile 'simm'"),
        (("[host.body]", f"[host.{'b' * 25}]"), "at most 24 characters"),
        (('name = "lab"', ""), "missing required field `name`"),
        (('name = "lab"', "name = 3"), "name"),
    ],
)  # fmt: skip
def test_a_plan_that_contradicts_itself_is_refused_with_what_to_do(
    change: tuple[str, str], told: str, tmp_path: Path
) -> None:
    assert change[0] in LAB
    with pytest.raises(ConfigError, match=told) as error:
        read(tmp_path, LAB.replace(*change))
    assert str(tmp_path / "site.toml") in str(error.value)


def test_files_that_are_no_plan_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no site .*site\.toml: write one"):
        plan.read(tmp_path)
    for damage in (b"name = ", b"\xff\xfe", b"[host]\n" * 100):
        (tmp_path / "site.toml").write_bytes(damage)
        with pytest.raises(ConfigError, match=r"site .*site\.toml"):
            plan.read(tmp_path)


def test_names_that_the_site_does_not_have_are_told_with_those_that_it_has(tmp_path: Path) -> None:
    site = read(tmp_path)
    with pytest.raises(ConfigError, match=r"site lab has no host 'brian'; .*did you mean brain"):
        site.host("brian")
    with pytest.raises(ConfigError, match=r"site lab has no host and no person 'adda'; .*did you mean ada"):
        site.role("adda")


def test_a_hub_joins_the_hosts_of_all_robots_and_the_persons(tmp_path: Path) -> None:
    site = read(tmp_path, HALL)
    assert {name: site.connects(name) for name in site.principals} == {
        "hub": (), "one": ("hub",), "two": ("hub",), "mind": ("hub",), "ada": ("hub",), "bo": ("hub",),
    }  # fmt: skip
    assert site.robots_of("hub") == ("a", "b")
    share = site.share_profile("hub")
    assert (share.robot, share.processes) == ("hub", ("gateway-hub",))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (('role = "hub"', 'role = "hub"\nprocesses = ["sim"]'), "a hub has its gateway alone"),
        (('listen = ["tls/10.77.0.9:7447"]', ""), "a hub listens"),
        (("[host.hub]", "[host.a]"), "a robot has this name"),
        (('role = "robot"\nrobot = "a"', 'role = "robot"'), "each host names its own"),
        (('role = "brain"', 'role = "brain"\nconnect = []'), "are not connected"),
    ],
)
def test_a_hub_that_cannot_work_is_refused(change: tuple[str, str], told: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=told):
        read(tmp_path, HALL.replace(*change))


@pytest.mark.parametrize(
    ("changes", "shares"),
    [
        ({}, {"body": ["packer"], "brain": ["frames-brain"]}),
        ({'"perception", ': "", '"capture", ': '"capture", "perception", '}, {"body": ["packer"], "brain": []}),
        (
            {'"capture", ': "", '"perception", ': '"capture", "perception", '},
            {"body": ["packer"], "brain": ["frames-brain"]},
        ),
    ],
    ids=["perception elsewhere", "persons alone", "recorder elsewhere"],
)
def test_what_carries_frames_runs_where_they_are_made_and_where_they_are_read(
    tmp_path: Path, changes: dict[str, str], shares: dict[str, list[str]]
) -> None:
    text = LAB
    for old, new in changes.items():
        text = text.replace(old, new)
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    site = plan.read(tmp_path)
    for host, carriers in shares.items():
        names = [component.name for component in site.share(host)]
        assert [name for name in names if name == "packer" or name.startswith("frames")] == carriers
        assert [*site.share_profile(host).processes] == names


def test_a_site_of_one_host_without_persons_carries_no_frames(tmp_path: Path) -> None:
    text = LAB.partition("[host.brain]")[0].replace('"sim"]', '"sim", "perception", "planning", "executive"]')
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    assert [one.name for one in plan.read(tmp_path).share("body")][-1] == "gateway-body"
