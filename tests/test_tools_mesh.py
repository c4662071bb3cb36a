"""`top`, `echo`, `hz` and `logs` against small services on a zenoh mesh."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
from operator_shell import Shell

from apps.cli import echo, exits, hz, top
from apps.cli.options import RobotChoice
from cocoro.bus.base import Qos
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock
from cocoro.messages import BaseCommand
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import BASE_COMMAND
from deploy.rundir import RunDir

pytestmark = pytest.mark.zenoh

ANY = RobotChoice()


@asynccontextmanager
async def robot() -> AsyncIterator[None]:
    """A planner that commands, a base that listens, and a participant whose keys are in no table."""
    async with (
        await ZenohBus.open(default("calliope", "robot")) as bus,
        Node("planning", bus, RealClock(), Robot.load(), health_hz=20.0) as planning,
        Node("base", bus, RealClock(), Robot.load(), health_hz=20.0) as base,
    ):
        base.inbox(BASE_COMMAND)
        foreign = bus.publisher("calliope/guest/wave", Qos.STATE)
        rude = bus.publisher("calliope/base/command", Qos.STATE)

        async def talk() -> None:
            async for _ in planning.every(50.0):
                planning.publish(BASE_COMMAND, BaseCommand(ahead_mps=0.1, turn_radps=0.0))
                foreign.put(msgpack.packb({"height_m": 1.5, "raw": b"123"}))
                rude.put(msgpack.packb({"ahead_mps": "fast"}))

        planning.ready()
        base.ready("all is well")
        planning.spawn(talk())
        yield


def on_mesh(command: Callable[[], Awaitable[int]]) -> int:
    async def scenario() -> int:
        async with robot():
            return await command()

    return asyncio.run(scenario())


def test_echo_prints_messages_of_types_that_it_knows_and_of_others(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert on_mesh(lambda: echo.print_messages(ANY, "guest/wave", 2, None, False, False)) == exits.DONE
    head = "calliope/guest/wave  (unknown type)"
    assert capsys.readouterr().out.splitlines() == 2 * [head, "  height_m: 1.5", "  raw: <3 bytes>"]

    assert on_mesh(lambda: echo.print_messages(ANY, "*/command", 4, None, True, False)) == exits.DONE
    heard = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(heard) == 4
    good = [entry["message"]["ahead_mps"] for entry in heard if "problem" not in entry]
    bad = [entry["problem"] for entry in heard if "problem" in entry]
    assert set(good) == {0.1}
    assert bad
    assert all("no good BaseCommand" in problem for problem in bad)
    assert {entry["type"] for entry in heard} == {"BaseCommand"}


def test_echo_of_a_silent_key_says_so_and_exits_with_1_when_its_time_is_over(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(echo, "HINT_S", 0.05)
    assert on_mesh(lambda: echo.print_messages(ANY, "no/thing", None, 0.3, False, False)) == exits.FAILED
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("nothing on calliope/no/thing yet") == 1


def test_hz_measures_every_key_that_it_hears(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert on_mesh(lambda: hz.show_rates(ANY, "**", 0.5, True, True)) == exits.DONE
    found = {report["key"]: report for report in json.loads(capsys.readouterr().out)}
    assert {"calliope/guest/wave", "calliope/base/command", "calliope/base/health"} <= set(found)
    wave = found["calliope/guest/wave"]
    assert wave["messages"] > 2
    assert wave["rate_hz"] > 0
    assert (wave["nominal_hz"], wave["stamped_hz"]) == (None, None)
    assert found["calliope/base/command"]["nominal_hz"] == 50.0


def test_hz_of_a_silent_key_exits_with_1(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert on_mesh(lambda: hz.show_rates(ANY, "no/thing", 0.5, True, False)) == exits.FAILED
    assert "nothing on calliope/no/thing yet" in capsys.readouterr().out


def in_top(capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    report = json.loads(capsys.readouterr().out)
    return ({row["service"]: row for row in report["services"]}, {row["topic"]: row for row in report["topics"]})


def test_top_tells_who_lives_what_it_costs_and_what_each_reader_misses(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = RunDir("calliope")
    run_dir.make()
    profile = {"name": "sim", "robot": "calliope", "processes": ["planning", "base", "perception"]}
    run_dir.profile_file.write_text(json.dumps(profile))

    async def after_a_while() -> int:
        async with asyncio.timeout(30.0):  # until a rejection appears in a health message
            while True:
                code = await top.show_top(ANY, True, True, 1.0)
                out = capsys.readouterr().out
                readers = [r for t in json.loads(out)["topics"] if t["topic"] == "base/command" for r in t["readers"]]
                if any(reader["rejected"] for reader in readers):
                    print(out)
                    return code

    assert on_mesh(after_a_while) == exits.FAILED  # perception should run, and does not
    services, topics = in_top(capsys)
    assert {name: row["state"] for name, row in services.items()} == {
        "planning": "ready", "base": "ready", "perception": "not alive",
    }  # fmt: skip
    assert services["base"]["health"]["text"] == "all is well"
    assert services["base"]["health"]["rss_mb"] > 10
    assert services["base"]["cpu_budget"] == 0.15
    command = topics["base/command"]
    assert (command["publisher"], command["nominal_hz"]) == ("planning", 50.0)
    (reader,) = command["readers"]
    assert reader["service"] == "base"
    assert "Expected `float`, got `str`" in reader["last_error"]


def test_top_for_people_has_a_line_for_each_service_and_topic(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert on_mesh(lambda: top.show_top(ANY, True, False, 1.0)) == exits.DONE
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines if line.startswith(("base ", "planning "))] == ["ready", "ready"]
    assert any(line.startswith("base/command ") and "planning" in line for line in lines)


@pytest.mark.process
@pytest.mark.parametrize("command", [["top", "--json"], ["echo", "guest/wave"], ["hz", "**"]], ids=" ".join)
def test_ctrl_c_ends_them_well(root: Path, command: list[str]) -> None:
    async def scenario() -> None:
        async with robot():
            running = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "apps.cli.main", *command, stdout=asyncio.subprocess.PIPE
            )
            assert running.stdout is not None
            assert await running.stdout.readline()
            running.send_signal(signal.SIGINT)
            await running.stdout.read()
            assert await running.wait() == exits.DONE

    asyncio.run(scenario())


@pytest.mark.process
def test_logs_follow_a_process_over_its_restart(tmp_path: Path) -> None:
    with Shell(tmp_path) as cocoro:
        assert cocoro("up", cocoro.profile("good"), "--detach").returncode == 0
        following = cocoro.start("logs", "--follow")
        following.until("good: joined the mesh")
        cocoro.target("good").signal(signal.SIGKILL)
        following.until("supervisor: good was killed by SIGKILL")
        following.until("good: joined the mesh")
        assert following.end(signal.SIGINT) == 0
