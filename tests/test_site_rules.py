"""Who may do what: rights by role and by what runs where, and the rules for zenoh that are compiled from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from site_rig import HALL, LAB

from bench import scale_site
from cocoro.bus.base import Qos
from cocoro.component import Component
from cocoro.errors import ConfigError
from cocoro.installed import all_requests, all_topics
from cocoro.keys import matches
from cocoro.topics import (
    BASE_COMMAND,
    BASE_STATE,
    CANCEL,
    DRIVE,
    ESTOP,
    FRAME,
    HEALTH,
    INTENT,
    OFFSET,
    PACKED,
    RESET,
    RUN,
    SERVOS,
    TIME,
    TRUTH,
    Topic,
)  # fmt: skip
from deploy import processes
from deploy.site import plan
from deploy.site.matrix import matrix
from deploy.site.rights import of_clocks, rights
from deploy.site.rules import IN, OUT, Rule, compiled, neighbours, table

ROBOT = "calliope"
AUTHOR = '[person.bob]\nrole = "author"\n'


@pytest.fixture
def lab(tmp_path: Path) -> plan.Site:
    (tmp_path / "site.toml").write_text(LAB + AUTHOR, encoding="utf-8")
    return plan.read(tmp_path)


def may_put(site: plan.Site, key: str) -> set[str]:
    """The principals that may publish on a key."""
    return {name for name in site.principals if any(matches(own, key) for own in rights(site, name, ROBOT).puts)}


def may_ask(site: plan.Site, key: str) -> set[str]:
    return {name for name in site.principals if rights(site, name, ROBOT).may_ask(key)}


def may_hear(site: plan.Site, key: str) -> set[str]:
    return {name for name in site.principals if rights(site, name, ROBOT).may_hear(key)}


# --- rights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("topic", all_topics(), ids=lambda topic: topic.name)
def test_only_the_host_of_its_publisher_may_publish_a_topic(topic: Topic[Any], lab: plan.Site) -> None:
    for host, row in lab.hosts.items():
        here = [processes.named(name) for name in row.processes]
        ours = [row for one in here for row in one.all_publishes() if row.name == topic.name]
        if not topic.per_service and not topic.local:
            assert (host in may_put(lab, topic.key(ROBOT))) == bool(ours)
    assert may_put(lab, topic.of("planning").key(ROBOT) if topic.per_service else topic.key(ROBOT)) <= {*lab.hosts}


def test_wheels_are_commanded_by_the_host_of_planning_alone(lab: plan.Site) -> None:
    assert may_put(lab, BASE_COMMAND.key(ROBOT)) == {"brain"}


def test_everybody_stops_and_operators_alone_operate(lab: plan.Site) -> None:
    persons = {"ada", "eve", "bob"}
    assert may_ask(lab, ESTOP.of("base").key(ROBOT)) == may_ask(lab, ESTOP.of("*").key(ROBOT)) == persons
    for request in all_requests():
        asking = may_ask(lab, (request.of("base") if request.per_service else request).key(ROBOT))
        if request.right == "operate":
            assert asking == {"ada"}, request.name
        else:
            assert asking >= persons, request.name
    assert {request.name for request in (RUN, RESET, SERVOS)} <= {
        request.name for request in all_requests() if request.right == "operate"
    }


def test_the_truth_is_heard_where_it_is_made_and_by_persons_and_by_no_other_host(lab: plan.Site) -> None:
    assert may_hear(lab, TRUTH.key(ROBOT)) == {"body", "ada", "eve", "bob"}


def test_a_recorder_on_another_host_hears_everything_but_the_truth(tmp_path: Path) -> None:
    text = LAB.replace('"capture", ', "").replace('"executive"]', '"executive", "capture"]')
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    site = plan.read(tmp_path)
    assert rights(site, "brain", ROBOT).may_hear("calliope/anything/at/all")
    assert not rights(site, "brain", ROBOT).may_hear(TRUTH.key(ROBOT))
    denied = [rule for rule in table(site, "body") if not rule.allow]
    local = tuple(topic.key(ROBOT) for topic in all_topics() if topic.local)
    assert Rule("brain", OUT, ("put",), (*local, TRUTH.key(ROBOT)), allow=False) in denied
    assert {rule.keys for rule in denied if rule.principal != "brain"} == {local}, "persons hear the truth"


def test_the_host_that_the_cockpit_runs_on_may_ask_what_its_page_asks_and_no_other_host(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(LAB.replace('"executive"]', '"executive", "cockpit"]'), encoding="utf-8")
    site = plan.read(tmp_path)
    for request in (RUN, CANCEL, DRIVE, RESET.of("base"), ESTOP.of("base")):
        assert rights(site, "brain", ROBOT).may_ask(request.key(ROBOT))
        assert not rights(site, "body", ROBOT).may_ask(request.key(ROBOT))
    assert not rights(site, "brain", ROBOT).may_ask(SERVOS.of("arm").key(ROBOT))
    assert rights(site, "brain", ROBOT).may_hear("calliope/planning/map")


def test_a_site_may_be_without_a_cockpit(lab: plan.Site) -> None:
    assert all("cockpit" not in host.processes for host in lab.hosts.values())
    assert "cockpit" in lab.profiles[ROBOT].processes
    assert not rights(lab, "brain", ROBOT).may_ask(RUN.key(ROBOT))


def test_an_author_publishes_and_serves_under_his_own_name_alone(lab: plan.Site) -> None:
    assert may_put(lab, "calliope/bob/painting") == {"bob"}
    assert rights(lab, "bob", ROBOT).puts == {"calliope/bob/**"}
    assert rights(lab, "bob", ROBOT).answers == {"calliope/bob/**"}


def test_a_third_partys_component_publishes_under_its_own_services_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = Component(name="painter", module="painter", doc="", publishes=(BASE_COMMAND,))
    monkeypatch.setattr(processes, "table", lambda: {"painter": bad})
    text = LAB.replace('"capture", "sim"', '"capture", "sim", "painter"')
    (tmp_path / "site.toml").write_text(text.replace('profile = "sim"', 'profile = "own.toml"'), encoding="utf-8")
    (tmp_path / "own.toml").write_text(
        'robot = "calliope"\nclock = "sim"\n'
        'processes = ["capture", "sim", "perception", "planning", "executive", "painter"]\n',
        encoding="utf-8",
    )
    with pytest.raises(ConfigError, match="painter of a third party publishes base/command"):
        plan.read(tmp_path)


def test_who_has_nothing_to_do_with_a_robot_may_do_nothing_with_it(lab: plan.Site) -> None:
    assert not any(rights(lab, "ada", "other"))


# --- rules ----------------------------------------------------------------------------------------


def allows(site: plan.Site, host: str, name: str, flow: str, message: str, key: str) -> bool:
    """Whether a host's rules let a message of a key pass on a principal's link."""
    found = [
        rule
        for rule in table(site, host)
        if rule.principal == name and rule.flow == flow and message in rule.messages
        if any(matches(own, key) for own in rule.keys)
    ]
    return bool(found) and all(rule.allow for rule in found)


def test_rules_are_kept_where_a_message_comes_in_and_where_it_goes_out(lab: plan.Site) -> None:
    wheels = BASE_COMMAND.key(ROBOT)
    assert allows(lab, "body", "brain", IN, "put", wheels)
    assert allows(lab, "brain", "body", OUT, "put", wheels)
    assert not allows(lab, "body", "ada", IN, "put", wheels)
    assert not allows(lab, "brain", "body", IN, "put", wheels), "nobody behind the body may command wheels either"
    assert allows(lab, "brain", "body", IN, "query", RUN.key(ROBOT)), "the body passes the operator's requests on"
    assert allows(lab, "body", "ada", IN, "query", RUN.key(ROBOT))
    assert not allows(lab, "body", "eve", IN, "query", RUN.key(ROBOT))


def test_a_host_keeps_rules_for_those_who_link_with_it_and_for_nobody_else(lab: plan.Site) -> None:
    assert set(neighbours(lab, "body")) == {"brain", "ada", "eve", "bob"}
    assert set(neighbours(lab, "brain")) == {"body"}


def test_what_is_given_to_zenoh_denies_by_default_and_names_the_admitted_certificates(lab: plan.Site) -> None:
    names = {"brain": ("brain.1", "brain.2"), "ada": ("ada.3",), "mallory": ("mallory.1",)}
    control = compiled(lab, "body", names)["access_control"]
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    subjects = {subject["id"]: subject for subject in control["subjects"]}
    assert subjects["brain"]["cert_common_names"] == ["brain.1", "brain.2"]
    assert set(subjects) == {"unixsock-stream", "brain", "ada"}, (
        "eve has no certificate, and mallory is not in the plan"
    )
    known = {rule["id"] for rule in control["rules"]}
    used = [rule for policy in control["policies"] for rule in policy["rules"]]
    assert sorted(used) == sorted(known), "each rule is somebody's, once"


def test_sizes_and_rates_are_those_of_the_table(lab: plan.Site) -> None:
    options = compiled(lab, "body", {})
    sizes = {
        key: row["size_limit"]
        for row in options["low_pass_filter"]
        for key in row["key_exprs"]
        if row["messages"] == ["put"]
    }
    assert all(sizes[(row.of("*") if row.per_service else row).key(ROBOT)] == row.max_bytes for row in all_topics())
    rates = {rule["key_expr"]: rule["freq"] for row in options["downsampling"] for rule in row["rules"]}
    assert rates[BASE_COMMAND.key(ROBOT)] == 500.0
    assert "calliope/executive/task" not in rates, "no event is ever dropped for coming too soon"
    assert rates[RUN.key(ROBOT)] == RUN.most_hz


def test_a_hub_drops_no_request_for_coming_soon_after_another_robots(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(HALL, encoding="utf-8")
    limited = compiled(plan.read(tmp_path), "hub", {})["downsampling"]
    assert [row["messages"] for row in limited] == [["put"]], "zenoh counts all keys of a rule as one"


def test_who_deals_with_all_robots_has_the_rules_of_one_at_a_hub(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(HALL, encoding="utf-8")
    site = plan.read(tmp_path)
    rows = [rule for rule in table(site, "hub") if rule.principal == "ada"]
    assert {key.partition("/")[0] for rule in rows for key in rule.keys} == {"*"}
    assert allows(site, "hub", "ada", IN, "query", RUN.key("a"))
    assert allows(site, "hub", "ada", OUT, "put", "b/base/state")
    assert not allows(site, "hub", "bo", OUT, "put", "a/base/state")


def test_the_rules_of_a_hub_grow_with_its_robots_and_those_of_a_robot_do_not(tmp_path: Path) -> None:
    keys = {}
    for robots in (2, 20):
        folder = tmp_path / str(robots)
        folder.mkdir()
        (folder / "site.toml").write_text(scale_site.text(robots, 7447), encoding="utf-8")
        site = plan.read(folder)
        keys[robots] = [sum(len(rule.keys) for rule in table(site, host)) for host in ("hub", "body1")]
        assert compiled(site, "hub", {})["transport/unicast/max_sessions"] > 1000 + 2 * robots
    assert keys[20][1] == keys[2][1]
    assert keys[20][0] < 10 * keys[2][0]


def test_requests_are_dropped_only_where_persons_link_and_stops_only_in_a_flood(lab: plan.Site) -> None:
    limits = {host: compiled(lab, host, {})["downsampling"] for host in ("body", "brain")}
    asked = {
        host: {rule["key_expr"]: rule["freq"] for row in rows if row["messages"] == ["query"] for rule in row["rules"]}
        for host, rows in limits.items()
    }
    assert RUN.key(ROBOT) in asked["body"]
    assert not asked["brain"], "one person's flood would have the requests of others dropped"
    assert asked["body"][ESTOP.of("base").key(ROBOT)] >= 200.0, "a stop within 5 ms of one that has passed"
    assert not [key for key in asked["body"] if "*" in key], "stops of several services would count as one"


def test_what_is_larger_than_any_message_is_not_put_together(lab: plan.Site) -> None:
    largest = compiled(lab, "body", {})["transport/link/rx/max_message_size"]
    assert max(topic.max_bytes for topic in all_topics()) < largest < 20 * 1024 * 1024


# --- the table for people -------------------------------------------------------------------------


def test_the_table_says_what_the_rules_say(lab: plan.Site) -> None:
    verbs = {"puts": (IN, "put"), "asks": (IN, "query"), "answers": (IN, "reply"), "shows": (IN, "liveliness_token")}
    for row in matrix(lab, ROBOT):
        for name in set(row.may) - {"body"}:
            for verb, (flow, message) in verbs.items():
                if row.kind in ("request", "token") or verb == "puts":
                    key = f"{ROBOT}/{row.key.replace('**', 'any')}"
                    assert (verb in row.may[name]) == allows(lab, "body", name, flow, message, key), (row.key, name)


def test_the_table_has_a_row_for_each_key_that_somebody_publishes_or_serves(lab: plan.Site) -> None:
    keys = {row.key for row in matrix(lab, ROBOT)}
    assert {"base/command", "sim/truth", "executive/run", "base/estop", "planning/alive", "bob/**"} <= keys
    assert "servos/about" not in keys, "no host of this site has the real servos"


# --- clocks ---------------------------------------------------------------------------------------


def test_hosts_and_persons_ask_any_gateway_for_the_time(lab: plan.Site) -> None:
    assert may_ask(lab, TIME.of("gateway-body").key(ROBOT)) == {*lab.principals}
    assert may_hear(lab, OFFSET.of("gateway-brain").key(ROBOT)) >= {"ada", "eve", "bob"}
    assert may_put(lab, OFFSET.of("gateway-brain").key(ROBOT)) == {"brain"}


def test_a_host_with_a_wrong_clock_passes_on_only_what_says_so(lab: plan.Site) -> None:
    only = of_clocks(lab, ROBOT)
    kept = table(lab, "brain", only=only)
    assert {rule.principal for rule in kept} == {rule.principal for rule in table(lab, "brain")}

    def passes(flow: str, message: str, key: str) -> bool:
        found = [rule for rule in kept if rule.flow == flow and message in rule.messages and rule.allow]
        return any(matches(keyexpr, key) for rule in found for keyexpr in rule.keys)

    for flow in (IN, OUT):
        for command in (INTENT, BASE_COMMAND, BASE_STATE, TRUTH):
            assert not passes(flow, "put", command.key(ROBOT))
        assert not passes(flow, "reply", RUN.key(ROBOT))
        assert not passes(flow, "liveliness_token", f"{ROBOT}/executive/alive")
    assert passes(IN, "reply", TIME.of("gateway-body").key(ROBOT))
    assert passes(OUT, "query", TIME.of("gateway-body").key(ROBOT))
    assert passes(OUT, "put", OFFSET.of("gateway-brain").key(ROBOT))
    assert passes(OUT, "put", HEALTH.of("gateway-brain").key(ROBOT))
    assert passes(IN, "declare_subscriber", f"{ROBOT}/**"), "the recorder's interest; its messages are held back"
    assert compiled(lab, "brain", {"body": ["body.1"]}, only=only)["access_control"]["enabled"]


# --- a hub ----------------------------------------------------------------------------------------


def test_a_hub_keeps_the_robots_apart_and_does_nothing_itself(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(HALL, encoding="utf-8")
    site = plan.read(tmp_path)
    assert set(neighbours(site, "hub")) == {"one", "two", "mind", "ada", "bo"}
    assert allows(site, "hub", "mind", IN, "put", "b/base/command")
    assert not allows(site, "hub", "mind", IN, "put", "a/base/command")
    assert allows(site, "hub", "ada", IN, "query", "a/executive/run")
    assert not allows(site, "hub", "bo", OUT, "put", "a/base/state")
    assert not any(rights(site, "hub", robot) != rights(site, "bo", "a") for robot in ("a", "b")), "no rights at all"
    assert allows(site, "two", "hub", IN, "put", "b/base/command"), "the hub passes on what the mind commands"
    assert not allows(site, "one", "hub", IN, "put", "a/base/command"), "and nobody commands the other one's wheels"
    keys = {key for row in compiled(site, "hub", {})["low_pass_filter"] for key in row["key_exprs"]}
    assert "*/base/command" in keys


def test_frames_cross_no_link_and_everybody_may_ask_for_packed_ones(lab: plan.Site) -> None:
    frames, packed = FRAME.key(ROBOT), PACKED.key(ROBOT)
    assert not may_put(lab, frames)
    assert not may_hear(lab, frames)
    assert may_ask(lab, packed) == {"brain", "ada", "eve", "bob"}
    assert not allows(lab, "body", "brain", OUT, "put", frames)
    assert not allows(lab, "body", "eve", OUT, "put", frames), "though she hears everything else"
    assert allows(lab, "body", "brain", IN, "query", packed)


def test_no_link_to_another_host_keeps_an_event_waiting(lab: plan.Site) -> None:
    (rule,) = compiled(lab, "body", {})["qos/network"]
    assert (rule["link_protocols"], rule["flows"]) == (["tls"], [OUT])
    assert rule["overwrite"] == {"congestion_control": "drop"}
    for topic in all_topics():
        key = (topic.of("base") if topic.per_service else topic).key(ROBOT)
        assert any(matches(keyexpr, key) for keyexpr in rule["key_exprs"]) == (topic.qos is Qos.EVENT), topic.name
