"""A robot over three hosts, as processes with certificates on a network that the test makes."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from operator_shell import PATIENCE_S
from websockets.sync.client import ClientConnection, connect

from apps.cli import exits
from bench.site_lab import BODY, BRAIN, COCKPIT_PORT, DESK, ROBOT, Lab, lab
from deploy.rundir import RunDir
from deploy.site import authority, place
from sim.network.network import Host, obstacle

pytestmark = [pytest.mark.process, pytest.mark.zenoh, pytest.mark.skipif(bool(obstacle()), reason=obstacle() or "-")]

PROGRAM = """
import asyncio, json, sys
import cocoro

async def tried(work):
    try:
        return ["done", str(await work)]
    except cocoro.CocoroError as error:
        return [type(error).__name__, str(error)]

async def main():
    async with cocoro.connect(site=sys.argv[1]) as robot:
        while (status := await robot.status()).base is None:
            pass  # each question takes its time
        told = {"name": robot.name, "alive": sorted(status.alive), "battery": status.base.battery_fraction}
        told["objects"] = sorted(one.label for one in await robot.objects())
        told["park"] = await tried(robot.park())
        told["stop"] = sorted((await robot.stop()).acknowledged)
        told["reset"] = await tried(robot.reset())
        print(json.dumps(told))

asyncio.run(main())
"""
"""A program of a person: looks, has the arm parked, stops the robot, releases it."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(
        tmp_path_factory.mktemp("site"), processes=("sim", "cockpit"), width=160, height=120, frame_rate_hz=10.0
    ) as made:
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


def of_program(site: Lab, who: str) -> dict[str, Any]:
    """What the program of a person at the desk tells."""
    process = site.desk.run([sys.executable, "-c", PROGRAM, site.as_person(who)[1]], stdout=subprocess.PIPE, text=True)
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    found: dict[str, Any] = json.loads(out)
    return found


def test_a_program_of_the_operator_looks_runs_a_task_and_stops_through_the_site(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    told = of_program(site, "ada")
    assert told["name"] == ROBOT
    assert {"base", "arm", "hand", "kinect", "perception", "planning", "executive"} <= {*told["alive"]}
    assert {"red_can", "green_can", "blue_can"} <= {*told["objects"]}
    assert 0.0 < told["battery"] <= 1.0
    assert told["park"][0] == "done"
    assert {"base", "arm", "hand"} <= {*told["stop"]}
    assert told["reset"][0] == "done"


def test_a_program_of_a_viewer_looks_and_stops_and_is_refused_all_else(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    told = of_program(site, "eve")
    assert {"base", "arm", "hand"} <= {*told["stop"]}
    for what in ("park", "reset"):
        assert told[what][0] == "RefusedError", told[what]
        assert "eve, viewer of site lab, may not" in told[what][1]
    assert of_program(site, "ada")["reset"][0] == "done"


@contextmanager
def page(site: Lab, who: str) -> Iterator[ClientConnection]:
    """The connection of a person's page at the desk with the cockpit on the robot's host."""
    own = site.site_of(site.desk) / place.CREDENTIALS / who
    context = ssl.create_default_context(cafile=str(own / "ca.pem"))
    context.load_cert_chain(own / "cert.pem", own / "key.pem")
    socket = site.desk.socket()
    socket.connect((site.body.address, COCKPIT_PORT))
    with connect(f"wss://{site.body.address}:{COCKPIT_PORT}/live", sock=socket, ssl=context) as connection:
        yield connection


def answer(page: ClientConnection, kind: str) -> dict[str, Any]:
    """The next message of that kind."""
    while True:
        text = page.recv(timeout=PATIENCE_S)
        message: dict[str, Any] = json.loads(text) if isinstance(text, str) else {}
        if message.get("kind") == kind:
            return message


def test_the_cockpit_of_a_host_lets_persons_do_on_other_machines_what_their_roles_may(site: Lab) -> None:
    until(lambda: whole(site), "the hosts are linked")
    with page(site, "eve") as looks:
        assert answer(looks, "hello")["role"] == "viewer"
        looks.send(json.dumps({"do": "run", "id": 1, "task": {"task": "park"}}))
        assert "may look and stop" in answer(looks, "reply")["text"]
        looks.send(json.dumps({"do": "stop", "id": 2}))
        assert {"base", "arm", "hand"} <= {*answer(looks, "reply")["data"]["acknowledged"]}
    with page(site, "ada") as operates:
        assert answer(operates, "hello")["role"] == "operator"
        operates.send(json.dumps({"do": "reset", "id": 1}))
        reply = answer(operates, "reply")
        assert reply["ok"], reply
        operates.send(json.dumps({"do": "run", "id": 2, "task": {"task": "park"}}))
        reply = answer(operates, "reply")
        assert reply["ok"], reply


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
