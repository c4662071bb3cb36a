"""The bench of many robots: its site is valid, and its generator keeps the topic table's rates and real sizes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from bench import scale_site
from bench.scale import Traffic, passed
from bench.scale_site import PERIOD_NS, Share
from cocoro.keys import matches
from cocoro.topics import BASE_COMMAND, BASE_STATE, HEALTH, INTENT
from deploy.site import plan
from deploy.site.rules import compiled, neighbours


@pytest.fixture
def site(tmp_path: Path) -> plan.Site:
    (tmp_path / "site.toml").write_text(scale_site.text(3, 7447), encoding="utf-8")
    return plan.read(tmp_path)


def shares(site: plan.Site) -> dict[str, Share]:
    return {name: scale_site.share_of(site, name) for name in site.hosts if name != scale_site.HUB}


def test_the_generated_site_is_valid_and_everybody_meets_at_the_hub(site: plan.Site) -> None:
    assert len(site.profiles) == 3
    others = {*site.principals} - {scale_site.HUB}
    assert all(site.connects(name) == (scale_site.HUB,) for name in others)
    assert {*neighbours(site, scale_site.HUB)} == others
    admitted = {name: [f"{name}.1"] for name in site.principals}
    subjects = compiled(site, scale_site.HUB, admitted)["access_control"]["subjects"]
    assert {row["id"] for row in subjects} > others


def test_the_hosts_of_a_robot_say_what_its_components_declare(site: plan.Site) -> None:
    found = shares(site)
    assert {BASE_STATE, INTENT} <= {*found["body1"].publishes}
    assert BASE_COMMAND in found["brain1"].publishes
    assert any(matches(name, BASE_COMMAND.name) for name in found["body1"].reads)
    assert HEALTH.of("planning") in found["brain1"].publishes
    assert {*found["body1"].stops} == {"base/estop", "arm/estop", "hand/estop", "executive/estop"}
    assert not {topic.name for share in found.values() for topic in share.publishes} & scale_site.LEFT_OUT


@pytest.mark.parametrize("phase_ns", [0, 7_000_000, PERIOD_NS - 1])
def test_the_schedule_keeps_the_rates_of_the_table(site: plan.Site, phase_ns: int) -> None:
    for share in shares(site).values():
        rates = [topic.rate_hz or 0.0 for topic in share.publishes]
        due = scale_site.schedule(rates, phase_ns)
        counted = Counter(each.topic for each in due)
        assert [counted[index] for index in range(len(rates))] == rates
        assert due == sorted(due)
        assert all(0 <= each.at_ns < PERIOD_NS for each in due)
        for index, rate_hz in enumerate(rates):
            times = [each.at_ns for each in due if each.topic == index]
            gaps = [b - a for a, b in zip(times, [*times[1:], times[0] + PERIOD_NS], strict=True)]
            assert max(gaps) - min(gaps) <= 1
            assert abs(min(gaps) - PERIOD_NS / rate_hz) <= 1


def test_messages_are_as_large_as_those_of_a_real_capture(site: plan.Site) -> None:
    for share in shares(site).values():
        for topic in share.publishes:
            assert 40 < scale_site.size(topic.name) <= topic.max_bytes
    assert scale_site.size("perception/obstacles") > 10 * scale_site.size("base/state") > 0


def test_what_passes_the_hub_is_what_somebody_beyond_it_wants(site: plan.Site) -> None:
    found = shares(site)
    sent = {BASE_COMMAND.key("r2"): 50}
    # To the body: it reads the key, and its recorder hears everything; one link.
    assert passed(site, found, sent) == Traffic(50, 50, 50 * scale_site.size(BASE_COMMAND.name), 100)
    sent = {BASE_STATE.key("r1"): 10}
    # To the brain, the operator and the viewer.
    assert passed(site, found, sent) == Traffic(10, 30, 30 * scale_site.size(BASE_STATE.name), 30)
    assert passed(site, found, {HEALTH.of("sim").key("r2"): 5}) == Traffic(0, 0, 0, 0)
