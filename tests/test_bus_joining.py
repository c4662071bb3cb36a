"""Joining a mesh over zenoh: the register of members, the configuration, and the connection to those present."""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from zenoh_rig import CHILD, PATIENCE_S, appears, changes, child, echo, left_in, local, scenario, who

from cocoro.bus.endpoints import ZenohConfig, default
from cocoro.bus.register import Membership, members
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import ConfigError, MeshError
from cocoro.private import default_run_dir

# The register


@scenario
async def test_members_that_join_at_once_are_all_connected_exactly_once(directory: Path) -> None:
    buses = await asyncio.gather(*(ZenohBus.open(local(directory, f"s{n}")) for n in range(6)))
    try:
        for bus in buses:
            for member in members(directory):
                await appears(bus, f"@cocoro/member/{member.identity}")
            assert len(bus._session.info.links()) == 5
    finally:
        for bus in buses:
            await bus.close()
    assert members(directory) == []
    assert left_in(directory) == ["lock"]


@pytest.mark.process
@scenario
async def test_the_register_says_who_is_there_and_forgets_the_dead(directory: Path) -> None:
    assert members(directory) == []
    async with child(directory, "base") as base, child(directory, "arm") as arm:
        await base.says("ready")
        await arm.says("ready")
        assert {(m.name, m.pid) for m in members(directory)} == {
            ("base", base.process.pid),
            ("arm", arm.process.pid),
        }
        await base.kill()
        assert [m.name for m in members(directory)] == ["arm"]
    assert members(directory) == []
    assert left_in(directory) == ["lock"]


def test_a_directory_that_others_may_write_to_is_refused(directory: Path) -> None:
    directory.mkdir()
    directory.chmod(0o777)
    with pytest.raises(ConfigError, match="others may write to it"):
        Membership.register(directory, "x")


def test_a_directory_that_others_may_replace_is_refused(directory: Path) -> None:
    directory.parent.chmod(0o777)
    with pytest.raises(ConfigError, match="others may replace what is in it"):
        Membership.register(directory, "x")


def test_a_directory_that_cannot_be_made_is_refused(directory: Path) -> None:
    directory.write_text("a file")
    with pytest.raises(ConfigError, match=r"robot: Not a directory.*COCORO_RUN_DIR"):
        Membership.register(directory, "x")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"directory": Path("/" + "x" * 100)}, "too long for a Unix socket"),
        ({"directory": Path("/run/a#b")}, "may not contain"),
        ({"directory": Path("/run/caf\udce9")}, "must be UTF-8"),
        ({"directory": Path("/run/a"), "mode": "client"}, "without mode, listen and connect"),
        ({"directory": Path("/run/a"), "connect": ("tcp/127.0.0.1:1",)}, "without mode, listen and connect"),
        ({}, "give a directory, or endpoints to listen on or connect to"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        ZenohConfig("x", **options)


def test_the_default_mesh_is_a_directory_for_each_robot(monkeypatch: pytest.MonkeyPatch, short_path: Path) -> None:
    monkeypatch.setenv("COCORO_RUN_DIR", str(short_path / "here"))
    assert default("calliope", "base").directory == short_path / "here" / "calliope"
    assert default("calliope", "base", short_path).directory == short_path / "calliope"
    monkeypatch.delenv("COCORO_RUN_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_run_dir() == Path("/run/user/7/cocoro")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert default_run_dir().name == f"cocoro-{os.getuid()}"


@pytest.mark.parametrize("robot", ["", "a/b", "*", "..", "a b", "@a", "-a"])
def test_a_robot_s_name_must_do_as_path_and_key(robot: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="robot name"):
        default(robot, "base", tmp_path)


@pytest.mark.process
def test_a_fork_does_not_take_its_parent_out_of_the_mesh(directory: Path) -> None:
    script = """
import atexit, os
async def main():
    bus = await join()
    if os.fork() == 0:
        atexit._run_exitfuncs()
        os._exit(0)
    os.wait()
    from cocoro.bus.register import members
    say(*(member.name for member in members(Path(sys.argv[1]))))
    assert len(await bus.alive("@cocoro/member/*")) == 1
    await bus.close()
asyncio.run(main())
"""
    run = subprocess.run(
        [sys.executable, "-c", CHILD + script, str(directory), "parent"], stdout=subprocess.PIPE, timeout=PATIENCE_S
    )
    assert (run.returncode, run.stdout.strip()) == (0, b"parent")


# Joining


@scenario
async def test_where_nobody_is_the_error_says_what_to_start(directory: Path) -> None:
    with pytest.raises(MeshError) as raised:
        await ZenohBus.open(local(directory), expect_mesh=True)
    assert str(directory) in str(raised.value)
    assert "`cocoro up`" in str(raised.value)
    assert members(directory) == []


@pytest.mark.process
def test_a_process_that_receives_in_one_thread_receives_all_in_order(directory: Path) -> None:
    script = """
from cocoro.bus.session import receive_in_one_thread
async def main():
    receive_in_one_thread()
    got, end = [], asyncio.Event()
    def take(key, payload):
        got.append(int(payload))
        if len(got) == 500:
            end.set()
    async with await join(shared_memory=False) as reader, await join(shared_memory=False) as writer:
        reader.subscribe("robot/count", Qos.EVENT, take, depth=1)
        publisher = writer.publisher("robot/count", Qos.EVENT)
        while not got:
            publisher.put(b"0")
            await asyncio.sleep(0)
        for number in range(1, 501):
            publisher.put(b"%d" % number)
        await end.wait()
        threads = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
        say(got == sorted(got), sum(name.startswith("rx") for name in threads))
asyncio.run(main())
"""
    run = subprocess.run(
        [sys.executable, "-c", CHILD + script, str(directory), "one"], stdout=subprocess.PIPE, timeout=PATIENCE_S
    )
    assert (run.returncode, run.stdout.split()) == (0, [b"True", b"1"])


@pytest.mark.process
@scenario
async def test_what_dead_processes_left_is_no_mesh(directory: Path) -> None:
    async with child(directory, "base") as base:
        await base.says("ready")
        base.signal(signal.SIGKILL)
        await base.process.wait()
        with pytest.raises(MeshError, match="no mesh at"):
            await ZenohBus.open(local(directory), expect_mesh=True)


@pytest.mark.process
@scenario
async def test_the_death_of_the_first_member_leaves_a_mesh_that_others_can_join(directory: Path) -> None:
    async with child(directory, "first") as first, child(directory, "second") as second:
        await first.says("ready")
        await second.says("ready")
        async with await ZenohBus.open(local(directory)) as witness:
            assert await who(witness) == ["first", "second"]
            async with changes(witness, "robot/first/alive") as news:
                assert await news.get()
                await first.kill()
                assert not await news.get()
            assert await who(witness) == ["second"]
            async with (
                child(directory, "third") as third,
                await ZenohBus.open(local(directory), expect_mesh=True) as late,
            ):
                await third.says("ready")
                await appears(late, "robot/third/alive")
                assert await who(late) == ["second", "third"]
                assert await who(witness) == ["second", "third"]


@pytest.mark.process
@scenario
async def test_a_member_that_has_stopped_is_named_and_does_not_keep_others_from_joining(
    directory: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with child(directory, "stuck") as stuck, child(directory, "base") as base:
        await stuck.says("ready")
        await base.says("ready")
        stuck.signal(signal.SIGSTOP)
        async with await ZenohBus.open(local(directory, patience_s=0.3), expect_mesh=True) as bus:
            assert f"no answer within 0.3 s from stuck (process {stuck.process.pid})" in caplog.text
            assert await who(bus) == ["base"]
            stuck.signal(signal.SIGCONT)
            await appears(bus, "robot/stuck/alive")
            assert await who(bus) == ["base", "stuck"]


@pytest.mark.process
@scenario
async def test_joining_that_is_cancelled_leaves_nothing_behind(directory: Path) -> None:
    async with child(directory, "stuck") as stuck:
        await stuck.says("ready")
        stuck.signal(signal.SIGSTOP)
        joining = asyncio.create_task(ZenohBus.open(local(directory, patience_s=PATIENCE_S)))
        await asyncio.sleep(0)  # it registers before it waits for anything
        assert {member.name for member in members(directory)} == {"stuck", "test"}
        joining.cancel()
        with pytest.raises(asyncio.CancelledError):
            await joining
        assert [member.name for member in members(directory)] == ["stuck"]


@scenario
async def test_a_member_that_leaves_meanwhile_is_not_waited_for(
    directory: Path, caplog: pytest.LogCaptureFixture
) -> None:
    leaver = Membership.register(directory, "leaver")
    joining = asyncio.create_task(ZenohBus.open(local(directory, patience_s=10 * PATIENCE_S)))
    while len(members(directory)) < 2:
        await asyncio.wait({joining}, timeout=0.01)
    leaver.leave()
    async with await joining:
        assert [member.name for member in members(directory)] == ["test"]
        assert "no answer" not in caplog.text


@scenario
async def test_who_cannot_have_the_register_s_lock_joins_all_the_same(directory: Path) -> None:
    async with await ZenohBus.open(local(directory, "first")) as first:
        first.serve("robot/first/who", echo)
        with (directory / "lock").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            async with await ZenohBus.open(local(directory, "second"), expect_mesh=True) as second:
                assert await second.call("robot/*/who", b"?", PATIENCE_S) == [("robot/first/who", True, b"?")]


@scenario
async def test_two_robots_on_one_machine_never_meet(short_path: Path) -> None:
    run_dir = short_path
    async with (
        await ZenohBus.open(default("one", "base", run_dir)) as one,
        await ZenohBus.open(default("two", "base", run_dir)) as two,
    ):
        one.serve("robot/estop", echo)
        assert await two.call("robot/estop", b"", PATIENCE_S) == []
        assert await two.alive("@cocoro/member/*") == [f"@cocoro/member/{members(run_dir / 'two')[0].identity}"]


def free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@scenario
async def test_clients_of_a_router_reach_each_other_at_once() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    client = ZenohConfig("client", mode="client", connect=(endpoint,))
    with pytest.raises(MeshError, match=f"no mesh at {endpoint}"):
        await ZenohBus.open(client, expect_mesh=True)
    router = await ZenohBus.open(ZenohConfig("router", mode="router", listen=(endpoint,)))
    async with router, await ZenohBus.open(client) as server:
        server.serve("robot/base/who", echo)
        server.declare_alive("robot/base/alive")
        for _ in range(3):
            async with await ZenohBus.open(client, expect_mesh=True) as late:
                assert await late.call("robot/*/who", b"?", PATIENCE_S) == [("robot/base/who", True, b"?")]
                assert await late.alive("robot/*/alive") == ["robot/base/alive"]


@scenario
async def test_peers_with_endpoints_reach_each_other_at_once() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with await ZenohBus.open(ZenohConfig("first", listen=(endpoint,))) as first:
        first.serve("robot/base/who", echo)
        second = ZenohConfig("second", listen=("tcp/127.0.0.1:0",), connect=(endpoint,))
        async with await ZenohBus.open(second, expect_mesh=True) as bus:
            assert bus.where == endpoint
            assert await bus.call("robot/*/who", b"?", PATIENCE_S) == [("robot/base/who", True, b"?")]
        nowhere = ZenohConfig(
            "third", listen=("tcp/127.0.0.1:0",), connect=(f"tcp/127.0.0.1:{free_port()}",), patience_s=0.1
        )
        with pytest.raises(MeshError, match="no mesh at"):
            await ZenohBus.open(nowhere, expect_mesh=True)


@scenario
async def test_an_option_that_zenoh_does_not_know_is_named(directory: Path) -> None:
    with pytest.raises(ConfigError, match="option transport/link/nonsense = 1"):
        await ZenohBus.open(local(directory, options={"transport/link/nonsense": 1}))
    assert members(directory) == []
