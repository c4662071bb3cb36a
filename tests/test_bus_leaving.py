"""Leaving a mesh over zenoh: processes that die, stop, end without a word or close."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from zenoh_rig import CHILD, FRAME, PATIENCE_S, appears, changes, child, local, scenario, who

from cocoro.bus.base import Qos
from cocoro.bus.register import members
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CallTimeoutError, MeshError

# Processes that die or stop


@pytest.mark.process
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


@pytest.mark.process
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


@pytest.mark.process
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


@pytest.mark.process
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
        reader.declare_alive("robot/reader/alive")
        async with await ZenohBus.open(local(directory)) as bus:
            await appears(bus, "robot/reader/alive")
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
