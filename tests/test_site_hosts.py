"""A robot over three hosts, as processes with certificates on a network that the test makes."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from operator_shell import PATIENCE_S

from apps.cli import exits
from bench.site_lab import BODY, BRAIN, DESK, ROBOT, Lab, lab
from deploy.rundir import RunDir
from deploy.site import authority, place
from sim.network.network import Host, obstacle

pytestmark = [pytest.mark.process, pytest.mark.zenoh, pytest.mark.skipif(bool(obstacle()), reason=obstacle() or "-")]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("site"), processes=("sim",), width=160, height=120, frame_rate_hz=10.0) as made:
        made.network.links().set(delay_ms=1.0)
        made.up()
        yield made


def until(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, what
        time.sleep(0.05)


def pids(host: Host) -> dict[str, int]:
    """The process of each service of a host, but the gateway's."""
    claims = RunDir(ROBOT, host.folder / "run").claims()
    return {service: by.pid for service, by in claims.items() if not service.startswith("gateway-")}


def gateway_pid(host: Host) -> int:
    claims = RunDir(ROBOT, host.folder / "run").claims()
    by = claims.get(f"gateway-{host.name}")
    return 0 if by is None else by.pid


def said(site: Lab, who: str, *arguments: str) -> tuple[int, str]:
    code, text, _ = site.command(site.desk, *arguments, *site.as_person(who))
    return code, text


def whole(site: Lab) -> bool:
    """Whether the operator sees the services of both hosts."""
    code, text = said(site, "ada", "status", "--json")
    return code == exits.DONE and '"planning"' in text and '"base"' in text


def test_the_operator_fetches_from_another_machine(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    fetched = asyncio.run(site.fetch())
    assert fetched.well, (fetched.said, fetched.truth)
    assert said(site, "ada", "put-down")[0] == exits.DONE


def test_a_viewer_stops_and_does_nothing_else(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    code, text = said(site, "eve", "fetch", "red_can")
    assert code == exits.REFUSED
    assert text == f"cocoro: eve, viewer of site lab, may not ask {ROBOT}/executive/run\n"
    code, text = said(site, "eve", "stop")
    assert code == exits.DONE, text
    assert text.startswith(f"{ROBOT}: stopped base, arm, hand, executive in ")
    assert said(site, "eve", "reset")[0] == exits.REFUSED
    code, text = said(site, "ada", "reset")
    assert code == exits.DONE, text


def test_a_robot_goes_on_without_its_gateway_which_comes_back(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    before, gateway = pids(site.body), gateway_pid(site.body)
    os.kill(gateway, signal.SIGKILL)
    _, text, _ = site.command(site.body, "status", "--json")
    assert '"base"' in text, "the host's own processes are there at once"
    until(lambda: gateway_pid(site.body) not in (0, gateway), "it is started again")
    until(lambda: whole(site), "the hosts are linked again")
    assert pids(site.body) == before


def test_a_certificate_is_renewed_while_the_robot_runs(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    before = pids(site.body), pids(site.brain)
    authority.renew(site.plan, BRAIN, datetime.now(UTC))
    fresh, there = (folder / place.CREDENTIALS / BRAIN for folder in (site.plan, site.site_of(site.brain)))
    shutil.copy(fresh / place.CERT, there)
    until(lambda: "the former rules stay" in site.log(site.brain, f"gateway-{BRAIN}"), "a key is missing still")
    shutil.copy(fresh / place.KEY, there)
    until(lambda: "linked with brain.2" in site.log(site.body, f"gateway-{BODY}"), "the new generation is admitted")
    site.deliver(site.body, (BODY,))
    site.deliver(site.desk, ())
    until(lambda: whole(site), "the hosts are linked")
    assert (pids(site.body), pids(site.brain)) == before


def test_who_is_revoked_is_out_when_the_gateway_has_heard_of_it(site: Lab, tmp_path: Path) -> None:
    until(lambda: whole(site), "the hosts are linked")
    authority.revoke(site.plan, "bob")
    site.deliver(site.body, (BODY,))
    until(lambda: said(site, "bob", "status")[0] == exits.NO_MESH, "bob is not let in any more")
    until(lambda: whole(site), "the others are")


def test_the_operator_is_at_the_third_host(site: Lab) -> None:
    assert site.desk.name == DESK
    code, text, _ = site.command(site.desk, "status")
    assert (code, text) == (exits.NO_MESH, "cocoro: no robot is up on this machine: start one with `cocoro up sim`\n")
