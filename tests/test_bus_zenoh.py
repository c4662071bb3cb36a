"""What only the zenoh bus can get wrong: processes that die, stop or forget to leave; the register; the threads."""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from cocoro.bus.base import Payload
from cocoro.bus.endpoints import ZenohConfig, default, default_run_dir
from cocoro.bus.members import Membership, members
from cocoro.bus.outbox import CAPACITY_BYTES, Outbox
from cocoro.bus.pool import POOL_BYTES, SharedPool, read
from cocoro.bus.ring import Ring
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CallTimeoutError, ConfigError, MeshError
from cocoro.topics import Qos

PATIENCE_S = 60.0
FRAME = bytes(1_536_000)

CHILD = """
import asyncio, sys
from pathlib import Path
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus
from cocoro.topics import Qos

async def echo(key, payload):
    return NAME.encode()

def say(*words):
    print(*words, flush=True)

NAME = sys.argv[2]

async def join(**options):
    return await ZenohBus.open(ZenohConfig(NAME, directory=Path(sys.argv[1]), lease_s=1.0, **options))
"""

SERVICE = (
    CHILD
    + """
def tell(key, payload):
    say(key, bytes(payload[:8]).decode())

async def main():
    bus = await join()
    bus.subscribe("robot/frame", Qos.FRAME, tell, depth=1)
    bus.subscribe("robot/state", Qos.STATE, tell, depth=1)
    bus.serve(f"robot/{NAME}/who", echo)
    bus.declare_alive(f"robot/{NAME}/alive")
    say("ready")
    await asyncio.get_running_loop().create_future()
asyncio.run(main())
"""
)


class Child:
    """A process in the mesh, which tells by lines what it does."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    async def line(self) -> str:
        assert self.process.stdout is not None
        return (await self.process.stdout.readline()).decode().strip()

    async def says(self, wanted: str) -> None:
        while (line := await self.line()) != wanted:
            assert line, f"the child ended before it said {wanted!r}"

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    async def kill(self) -> None:
        if self.process.returncode is None:
            self.process.kill()
        await self.process.wait()


@asynccontextmanager
async def child(directory: Path, name: str, script: str = SERVICE) -> AsyncIterator[Child]:
    started = Child(
        await asyncio.create_subprocess_exec(sys.executable, "-c", script, str(directory), name, stdout=subprocess.PIPE)
    )
    try:
        yield started
    finally:
        await started.kill()


@pytest.fixture
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("m") / "robot"


def scenario(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(asyncio.wait_for(test(**fixtures), PATIENCE_S))

    return pytest.mark.zenoh(run)


def local(directory: Path, name: str = "test", **options: Any) -> ZenohConfig:
    return ZenohConfig(name, directory=directory, **{"lease_s": 1.0, **options})


@asynccontextmanager
async def changes(bus: ZenohBus, key: str) -> AsyncIterator[asyncio.Queue[bool]]:
    """Whether a token lives, as it changes."""
    news: asyncio.Queue[bool] = asyncio.Queue()
    watch = bus.watch_alive(key, lambda _, alive: news.put_nowait(alive))
    yield news
    watch.close()


async def appears(bus: ZenohBus, key: str) -> None:
    async with changes(bus, key) as news:
        assert await news.get()


async def who(bus: ZenohBus) -> list[str]:
    return sorted(reply.payload.decode() for reply in await bus.call("robot/*/who", b"", PATIENCE_S))


def left_in(directory: Path) -> list[str]:
    return [path.name for path in directory.iterdir()]


async def echo(key: str, payload: Payload) -> bytes:
    return bytes(payload)


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
    with pytest.raises(ConfigError, match="only this user can write to"):
        Membership.register(directory, "x")


def test_a_directory_that_others_may_replace_is_refused(directory: Path) -> None:
    directory.parent.chmod(0o777)
    with pytest.raises(ConfigError, match="only this user can write to or replace"):
        Membership.register(directory, "x")


def test_a_directory_that_cannot_be_made_is_refused(directory: Path) -> None:
    directory.write_text("a file")
    with pytest.raises(ConfigError, match="choose another run directory"):
        Membership.register(directory, "x")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"directory": Path("/" + "x" * 100)}, "too long for a Unix socket"),
        ({"directory": Path("/run/a#b")}, "may not contain"),
        ({"directory": Path("/run/a"), "mode": "client"}, "without mode, listen and connect"),
        ({"directory": Path("/run/a"), "connect": ("tcp/127.0.0.1:1",)}, "without mode, listen and connect"),
        ({}, "say a directory, or where to listen or connect"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        ZenohConfig("x", **options)


def test_the_default_mesh_is_a_directory_for_each_robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COCORO_RUN_DIR", str(tmp_path / "here"))
    assert default("calliope", "base").directory == tmp_path / "here" / "calliope"
    assert default("calliope", "base", tmp_path).directory == tmp_path / "calliope"
    monkeypatch.delenv("COCORO_RUN_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_run_dir() == Path("/run/user/7/cocoro")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert default_run_dir().name == f"cocoro-{os.getuid()}"


@pytest.mark.parametrize("robot", ["", "a/b", "*", "..", "a b", "@a", "-a"])
def test_a_robot_s_name_must_do_as_path_and_key(robot: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="robot name"):
        default(robot, "base", tmp_path)


def test_a_fork_does_not_take_its_parent_out_of_the_mesh(directory: Path) -> None:
    script = """
import atexit, os
async def main():
    bus = await join()
    if os.fork() == 0:
        atexit._run_exitfuncs()
        os._exit(0)
    os.wait()
    from cocoro.bus.members import members
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
    assert str(raised.value) == f"no mesh at {directory}: start one with `cocoro up`"
    assert members(directory) == []


@scenario
async def test_what_dead_processes_left_is_no_mesh(directory: Path) -> None:
    async with child(directory, "base") as base:
        await base.says("ready")
        base.signal(signal.SIGKILL)
        await base.process.wait()
        with pytest.raises(MeshError, match="no mesh at"):
            await ZenohBus.open(local(directory), expect_mesh=True)


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
async def test_two_robots_on_one_machine_never_meet(tmp_path_factory: pytest.TempPathFactory) -> None:
    run_dir = tmp_path_factory.mktemp("m")
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


# Processes that die or stop


@scenario
async def test_a_killed_process_is_known_to_be_dead_at_once(directory: Path) -> None:
    # With a lease this long, only the broken connection can tell.
    async with (
        child(directory, "base") as base,
        await ZenohBus.open(local(directory, lease_s=10 * PATIENCE_S)) as bus,
    ):
        async with changes(bus, "robot/base/alive") as news:
            assert await news.get()
            base.signal(signal.SIGKILL)
            assert not await news.get()
        assert await who(bus) == []


@scenario
async def test_a_reader_that_has_stopped_stalls_nobody_and_is_back_when_it_goes_on(directory: Path) -> None:
    count = 60
    async with child(directory, "stuck") as stuck:
        await stuck.says("ready")
        async with (
            await ZenohBus.open(local(directory, "publisher")) as bus,
            await ZenohBus.open(local(directory, "reader")) as reader,
        ):
            keys = {"frame": Qos.FRAME, "state": Qos.STATE, "command": Qos.COMMAND, "event": Qos.EVENT}
            publishers = {name: bus.publisher(f"robot/{name}", qos) for name, qos in keys.items()}
            came = {name: asyncio.Event() for name in keys}
            events: list[int] = []
            reader.subscribe("robot/event", Qos.EVENT, lambda _, payload: events.append(int(bytes(payload))), depth=1)
            for name, qos in keys.items():
                reader.subscribe(f"robot/{name}", qos, lambda key, _: came[key[6:]].set(), depth=1)
            reader.declare_alive("robot/reader/alive")
            await appears(bus, "robot/reader/alive")

            life: asyncio.Queue[bool] = asyncio.Queue()
            bus.watch_alive("robot/stuck/alive", lambda _, alive: life.put_nowait(alive))
            assert await life.get()
            stuck.signal(signal.SIGSTOP)
            frames = 0
            for number in range(count):
                frames += came["frame"].is_set()
                for event in came.values():
                    event.clear()
                publishers["frame"].put(b"%08d" % number + FRAME)
                for name in ("state", "command", "event"):
                    publishers[name].put(b"%d" % number)
                # A frame may be dropped where frames are congested; nothing else may be.
                for name in ("state", "command", "event"):
                    await came[name].wait()
            assert events == list(range(count))
            assert frames > 0

            assert not await life.get()
            stuck.signal(signal.SIGCONT)
            assert await life.get()
            saying = asyncio.create_task(stuck.says("robot/frame comeback"))
            while not saying.done():
                publishers["frame"].put(b"comeback" + FRAME)
                await asyncio.wait({saying}, timeout=0.1)
            await saying


@scenario
async def test_a_caller_is_not_kept_by_a_server_that_has_stopped(directory: Path) -> None:
    async with child(directory, "base") as base, child(directory, "stuck") as stuck:
        await base.says("ready")
        await stuck.says("ready")
        async with await ZenohBus.open(local(directory, lease_s=PATIENCE_S)) as bus:
            stuck.signal(signal.SIGSTOP)
            replies = await bus.call("robot/*/who", b"", 0.3)
            assert [reply.payload for reply in replies] == [b"base"]
            with pytest.raises(CallTimeoutError, match="robot/stuck/who: no answer"):
                await bus.call("robot/stuck/who", b"", 0.1)


# Leaving


ENDINGS = {
    "returns": ("asyncio.run(main())", 0),
    "leaves its loop running": (
        "loop = asyncio.new_event_loop(); loop.run_until_complete(main()); asyncio.set_event_loop(loop)",
        0,
    ),
    "exits": ("asyncio.run(main()); sys.exit(3)", 3),
    "closes": ("asyncio.run(main(close=True))", 0),
    "is ended by a signal": ("asyncio.run(main()); import os; os.kill(os.getpid(), 15)", -15),
}


@pytest.mark.parametrize("ending", ENDINGS)
@scenario
async def test_a_process_ends_cleanly_with_a_session_that_is_busy(directory: Path, ending: str) -> None:
    script, status = ENDINGS[ending]
    forgetful = (
        CHILD
        + """
async def main(close=False):
    global bus
    bus = await join()
    first = asyncio.Event()
    bus.subscribe("robot/**", Qos.EVENT, lambda key, payload: first.set(), depth=1)
    bus.subscribe("robot/**", Qos.STATE, lambda key, payload: None, depth=1)
    bus.watch_alive("**", lambda key, alive: None)
    bus.serve("robot/who", echo)
    bus.declare_alive("robot/forgetful/alive")
    events = bus.publisher("other", Qos.EVENT)
    frames = bus.publisher("other/frame", Qos.FRAME)
    await first.wait()
    events.put(b"x")
    if close:
        await bus.close()
"""
        + script
    )
    async with await ZenohBus.open(local(directory)) as bus:
        publisher = bus.publisher("robot/state", Qos.STATE)
        life: asyncio.Queue[bool] = asyncio.Queue()
        bus.watch_alive("robot/forgetful/alive", lambda _, alive: life.put_nowait(alive))
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-W", "error", "-c", forgetful, str(directory), "forgetful"),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        output = asyncio.create_task(process.communicate())
        while not output.done():
            publisher.put(b"still")
            await asyncio.sleep(0)
        loop_left_open = b"unclosed event loop" if ending == "leaves its loop running" else b""
        stdout, stderr = output.result()
        assert (process.returncode, stdout) == (status, b"")
        assert stderr == b"" or (loop_left_open and loop_left_open in stderr)
        assert [await life.get(), await life.get()] == [True, False]
        assert [member.name for member in members(directory)] == ["test"]


@scenario
async def test_leaving_sends_the_events_that_wait(directory: Path) -> None:
    count = 2000
    async with await ZenohBus.open(local(directory)) as reader:
        received: asyncio.Queue[int] = asyncio.Queue()
        reader.subscribe("robot/event", Qos.EVENT, lambda _, payload: received.put_nowait(int(bytes(payload))), depth=1)
        async with await ZenohBus.open(local(directory)) as bus:
            publisher = bus.publisher("robot/event", Qos.EVENT)
            for number in range(count):
                publisher.put(b"%d" % number)
        assert [await received.get() for _ in range(count)] == list(range(count))


@scenario
async def test_after_leaving_a_call_says_so(directory: Path) -> None:
    bus = await ZenohBus.open(local(directory))
    await bus.close()
    with pytest.raises(MeshError, match="has been left"):
        await bus.call("robot/who", b"", PATIENCE_S)
    with pytest.raises(MeshError, match="has been left"):
        await bus.alive("**")


# Between the threads


def test_a_ring_keeps_the_newest_counts_the_rest_and_wakes_the_loop_once() -> None:
    wakes = []

    class Loop(asyncio.SelectorEventLoop):
        def call_soon_threadsafe(self, *args: Any, **kwargs: Any) -> asyncio.Handle:
            wakes.append(1)
            return super().call_soon_threadsafe(*args, **kwargs)

    async def test() -> None:
        got: list[tuple[str, int]] = []
        ring = Ring[int](asyncio.get_running_loop(), lambda key, item: got.append((key, item)), depth=2)
        pushing = threading.Thread(target=lambda: [ring.push(key, n) for n in range(100) for key in "ab"])
        pushing.start()
        pushing.join()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert got == [("a", 98), ("a", 99), ("b", 98), ("b", 99)]
        assert ring.skipped == 196
        assert len(wakes) == 1
        ring.push("a", 100)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert got[-1] == ("a", 100)

    with asyncio.Runner(loop_factory=Loop) as runner:
        runner.run(test())


def test_a_ring_without_depth_keeps_all_in_order_over_all_keys() -> None:
    async def test() -> None:
        got: list[str] = []
        ring = Ring[None](asyncio.get_running_loop(), lambda key, _: got.append(key), depth=None)
        keys = [f"{n % 7}" for n in range(1000)]
        for key in keys:
            ring.push(key, None)
        await asyncio.sleep(0)
        assert got == keys
        assert ring.skipped == 0

    asyncio.run(test())


def test_a_ring_loses_no_count_between_threads() -> None:
    async def test() -> None:
        delivered = 0
        done = asyncio.Event()

        def deliver(key: str, item: int) -> None:
            nonlocal delivered
            delivered += 1

        loop = asyncio.get_running_loop()
        ring = Ring(loop, deliver, depth=1)
        threads = [
            threading.Thread(target=lambda: [ring.push("x", n) for n in range(5000)], name=str(t)) for t in range(4)
        ]

        def join() -> None:
            for thread in threads:
                thread.join()
            loop.call_soon_threadsafe(done.set)

        for thread in threads:
            thread.start()
        threading.Thread(target=join).start()
        await done.wait()
        await asyncio.sleep(0)
        assert delivered + ring.skipped == 20_000

    asyncio.run(test())


def test_a_ring_whose_loop_is_closed_takes_samples_in_silence() -> None:
    loop = asyncio.new_event_loop()
    ring = Ring[int](loop, lambda key, item: None, depth=None)
    loop.close()
    ring.push("x", 1)
    ring.push("x", 2)
    assert ring._waiting == {}


def test_an_outbox_never_keeps_the_sender_waiting_and_counts_what_it_cannot_take() -> None:
    outbox = Outbox("test")
    go_on, sent = threading.Event(), []
    outbox.put(lambda: (go_on.wait(), sent.append("first"))[0], 1)  # type: ignore[func-returns-value]
    outbox.put(lambda: sent.append("second"), CAPACITY_BYTES - 1)
    outbox.put(lambda: sent.append("too much"), 1)
    assert outbox.lost == 1
    go_on.set()
    outbox.close(PATIENCE_S)
    assert sent == ["first", "second"]


def test_an_outbox_that_cannot_send_ends_all_the_same() -> None:
    outbox, never = Outbox("test"), threading.Event()
    outbox.put(lambda: never.wait() and None, 1)
    outbox.close(0.01)
    never.set()


def test_a_pool_that_is_full_lets_samples_go_by_copy() -> None:
    pool = SharedPool()
    held = [pool.hold(FRAME) for _ in range(POOL_BYTES // len(FRAME) + 2)]
    by_copy = [sample for sample in held if isinstance(sample, bytes)]
    assert pool.missed == len(by_copy) > 0
    shared = [sample for sample in held if not isinstance(sample, bytes)]
    assert len(shared) >= 10
    assert all(read(sample) == FRAME for sample in shared)
    held.clear()
    shared.clear()
    assert not isinstance(pool.hold(FRAME), bytes)


def test_a_sample_whose_memory_was_taken_back_is_not_read() -> None:
    class Held:
        def is_valid(self) -> bool:
            return False

    class Payload:
        def to_bytes(self) -> bytes:
            return b"half of one and half of another"

        def as_shm(self) -> Held:
            return Held()

    assert read(Payload()) is None  # type: ignore[arg-type]
