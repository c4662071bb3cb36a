"""The machine's shared memory: what is taken of it, what happens without, and that nothing of it is left."""

from __future__ import annotations

import asyncio
import logging
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from bus_rig import known
from namespace_rig import Namespace, needs_root
from zenoh_rig import CHILD, FRAME, PATIENCE_S, PUBLISHER, held, local, scenario

from apps.cli import doctor
from cocoro.bus import shared
from cocoro.bus.base import Payload, Qos
from cocoro.bus.zenoh import ZenohBus
from cocoro.checks import Check
from cocoro.component import Component
from cocoro.topics import FRAME as FRAME_TOPIC
from deploy import profiles
from deploy.processes import COMPONENTS, shared_bytes
from deploy.rundir import RunDir


class Room(NamedTuple):
    """The fields of statvfs that are used."""

    f_bavail: int
    f_frsize: int = 1


def has_free(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Have `count` bytes free in shared memory, without a limit for locked memory."""
    monkeypatch.setattr(os, "statvfs", lambda _: Room(count))
    monkeypatch.setattr(shared, "lockable_bytes", lambda: None)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that replaces /dev/shm."""
    monkeypatch.setattr(shared, "PLACE", tmp_path)
    return tmp_path


# --- what is needed -----------------------------------------------------------------------------------


def test_what_a_profile_needs_comes_from_who_publishes_and_who_reads_frames() -> None:
    publisher = shared.POOL_BYTES + shared.PROCESS_BYTES + shared.SESSION_BYTES
    for name in ("sim", "sim-wire", "robot"):
        assert shared_bytes(profiles.read(name).rows()) == publisher + 3 * shared.SESSION_BYTES
    assert shared_bytes(profiles.read("replay").rows()) == 2 * shared.SESSION_BYTES
    assert shared_bytes([]) == 0
    other = Component(name="stereo", module="x", services=("stereo",), doc="Another camera.", frames="publishes")
    assert shared_bytes([*profiles.read("sim").rows(), other]) == 2 * publisher + 3 * shared.SESSION_BYTES


def test_who_publishes_the_frames_says_so_in_the_process_table() -> None:
    assert [row for row in COMPONENTS if FRAME_TOPIC in row.publishes] == [
        row for row in COMPONENTS if row.frames == "publishes"
    ]


@pytest.mark.process
@needs_root
@pytest.mark.zenoh
@pytest.mark.parametrize(("kind", "publishers", "readers"), [("publisher", 1, 0), ("reader", 0, 1), ("plain", 0, 0)])
def test_what_is_needed_is_what_is_taken_and_given_back(
    directory: Path, kind: str, publishers: int, readers: int
) -> None:
    """Measured where nobody else takes anything; a service without frames takes nothing."""
    with Namespace({shared.PLACE: "size=64m"}) as namespace:
        process = subprocess.run(
            [*namespace.prefix, sys.executable, "-c", PUBLISHER, str(directory), kind],
            input="\n", capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr
        assert process.stdout.split() == ["took", str(shared.need_bytes(publishers, readers))]
        assert list(namespace.at(shared.PLACE).iterdir()) == []


def test_too_little_is_said_with_by_how_much(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    has_free(monkeypatch, 16_000_000)
    assert shared.obstacle(26_500_000) == (
        f"{place} has 16.0 MB free, 26.5 MB are needed (10.5 MB more): make room, or mount it larger"
    )
    assert shared.obstacle(16_000_000) == ""


def test_no_shared_memory_at_all_is_said(place: Path) -> None:
    place.rmdir()
    assert shared.obstacle(1) == f"{place}: No such file or directory"
    assert shared.obstacle(0) == ""


def test_what_may_not_be_locked_in_memory_is_said(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh locks its segments; a login has 8 MB for that on most systems."""
    monkeypatch.setattr(shared, "lockable_bytes", lambda: 8_388_608)
    assert shared.obstacle(1) == (
        "a process of this user's may lock 8.4 MB in memory, 27.3 MB are needed: raise memlock in "
        "/etc/security/limits.conf (LimitMEMLOCK of a unit)"
    )


UNPRIVILEGED = """
import os, resource, sys
from cocoro.bus.declared import SharedPool
from cocoro.bus import shared
try:
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (int(sys.argv[1]), int(sys.argv[2])))
except ValueError:
    print("no such limit here")
    os._exit(0)
os.setgid(65534); os.setuid(65534)
pool = SharedPool()
print(pool.trouble)
print(isinstance(pool.hold(bytes(1_500_000)), bytes))
print(*shared.segments().values())
shared.release()
print(*shared.segments().values())
os._exit(0)
"""


@pytest.mark.process
@needs_root
@pytest.mark.zenoh
@pytest.mark.parametrize(
    ("soft", "hard", "has_it"), [(0, 8 << 20, False), (8 << 20, 64 << 20, True), (64 << 20, 64 << 20, True)]
)
def test_a_user_who_may_not_lock_enough_leaves_nothing_and_one_who_may_has_a_pool(
    soft: int, hard: int, has_it: bool
) -> None:
    with Namespace({shared.PLACE: "size=64m,mode=1777"}) as namespace:
        told = subprocess.run(
            [*namespace.prefix, sys.executable, "-c", UNPRIVILEGED, str(soft), str(hard)],
            capture_output=True, text=True, timeout=PATIENCE_S, check=True,
        ).stdout.splitlines()  # fmt: skip
    if told == ["no such limit here"]:
        pytest.skip("the limit of memory to be locked cannot be raised here")
    if has_it:
        assert told[:2] == ["", "False"]
        assert sorted(map(int, told[2].split())) == [shared.PROCESS_BYTES, shared.POOL_BYTES]
    else:
        assert told[0].startswith("a process of this user's may lock 8.4 MB in memory, 27.3 MB are needed")
        assert told[1:] == ["True", "", ""]
    assert told[-1] == ""


def test_the_limit_is_raised_as_far_as_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = [(4096, 1 << 26)]
    monkeypatch.setattr(shared, "_IPC_LOCK", 0)
    monkeypatch.setattr(resource, "getrlimit", lambda _: limits[-1])
    monkeypatch.setattr(resource, "setrlimit", lambda _, both: limits.append(both))
    assert shared.lockable_bytes() == 1 << 26
    limits.append((resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert shared.lockable_bytes() is None


def test_the_doctor_says_what_the_profile_needs_and_whether_it_is_there(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(profile: str, free_bytes: int) -> Check:
        has_free(monkeypatch, free_bytes)
        with monkeypatch.context() as patch:
            patch.setattr(doctor, "_disk", lambda _: iter(()))
            return next(check for check in doctor.examine(profiles.read(profile)) if check.name == "shared memory")

    assert told("replay", 1 << 30) == ("shared memory", "ok", "enough for the 0.0 MB of the frames")
    assert told("sim", 1 << 30) == ("shared memory", "ok", "enough for the 26.5 MB of the frames")
    why = f"{shared.PLACE} has 16.0 MB free, 26.5 MB are needed (10.5 MB more): make room, or mount it larger"
    assert told("sim", 16_000_000) == ("shared memory", "note", f"{why}; until then {shared.COSTS}")
    claims = RunDir("calliope").claim("sim", ["kinect"])
    assert told("sim", 0).text.endswith(" MB in use")
    claims[0].release()


@needs_root
def test_the_doctor_names_a_run_directory_that_is_another_user_s(root: Path) -> None:
    RunDir("calliope").make()
    os.chown(root / "calliope", 65534, 65534)
    checks = [check for check in doctor.examine(profiles.read("replay")) if check.name == "robot's folder"]
    assert [check.state for check in checks] == ["bad"]
    assert checks[0].text.startswith(f"run directory {root}/calliope: it belongs to nobody")


# --- without ------------------------------------------------------------------------------------------


@pytest.mark.alone  # a large frame is dropped for a receiver that does not read for 25 ms
@scenario
async def test_frames_reach_a_receiver_without_shared_memory(directory: Path, needs_pool: None) -> None:
    """Frames arrive whole and in order beside a receiver with shared memory, from a publisher with it."""
    async with (
        await ZenohBus.open(local(directory, "publisher")) as publisher,
        await ZenohBus.open(local(directory, "plain", shared_memory=False)) as plain,
        await ZenohBus.open(local(directory, "shared")) as sharing,
    ):
        got: dict[str, list[bytes]] = {"plain": [], "shared": []}
        came = asyncio.Event()

        def hear(who: str, payload: Payload) -> None:
            got[who].append(bytes(payload))
            came.set()

        plain.subscribe("robot/frame", Qos.FRAME, lambda _, payload: hear("plain", payload), depth=1)
        sharing.subscribe("robot/frame", Qos.FRAME, lambda _, payload: hear("shared", payload), depth=1)
        for bus in (plain, sharing):
            await known(bus, publisher)
        frames = publisher.publisher("robot/frame", Qos.FRAME)
        assert not frames.trouble
        sent = [number.to_bytes(4, "little") + FRAME for number in range(5)]
        for number, frame in enumerate(sent):
            frames.put(frame)
            while not all(len(each) > number for each in got.values()):
                came.clear()
                await came.wait()
        assert got == {"plain": sent, "shared": sent}


@pytest.fixture
def no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    has_free(monkeypatch, 0)


@scenario
async def test_without_room_a_session_opens_and_a_publisher_says_why_its_frames_are_copied_once(
    directory: Path, no_room: None, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        async with await ZenohBus.open(local(directory, "publisher")) as bus:
            before = held()
            publisher = bus.publisher("robot/frame", Qos.FRAME)
            for _ in range(3):
                publisher.put(FRAME)
            assert set(held()) <= set(before)  # what earlier tests left may go meanwhile
    why = f"{shared.PLACE} has 0 kB free, 12 kB are needed (12 kB more): make room, or mount it larger"
    assert publisher.trouble == f"no shared memory: {why}; {shared.COSTS}"
    assert [record.message for record in caplog.records] == [f"no shared memory: {why}; {shared.COSTS}"]


@scenario
async def test_room_for_a_session_but_not_for_frames_is_said_once(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    has_free(monkeypatch, 16_000_000)
    with caplog.at_level(logging.WARNING):
        async with await ZenohBus.open(local(directory, "publisher")) as bus:
            publisher = bus.publisher("robot/frame", Qos.FRAME)
            publisher.put(FRAME)
            publisher.put(FRAME)
    assert "16.0 MB free, 26.5 MB are needed (10.5 MB more)" in publisher.trouble
    assert [record.message for record in caplog.records] == [f"robot/frame: {publisher.trouble}"]


@pytest.mark.process
@needs_root
@pytest.mark.zenoh
def test_what_fills_between_the_look_and_the_taking_ends_nothing(directory: Path) -> None:
    """Zenoh itself is refused then: the session opens without, and what was begun is given back."""
    script = (
        CHILD
        + """
from cocoro.bus import shared
shared.obstacle = lambda wanted: ""
async def main():
    async with await join() as bus:
        say("open", bus._unshared != "", *shared.segments())
        publisher = bus.publisher("robot/frame", Qos.FRAME)
        say("pool", publisher.trouble != "", *shared.segments())
asyncio.run(main())
"""
    )
    for room, told in (("size=4k", ["open True", "pool True"]), ("size=16m", None)):
        with Namespace({shared.PLACE: room}) as namespace:
            run = subprocess.run(
                [*namespace.prefix, sys.executable, "-c", script, str(directory), "publisher"],
                capture_output=True, text=True, timeout=PATIENCE_S, check=False,
            )  # fmt: skip
            assert run.returncode == 0, run.stderr
            lines = run.stdout.splitlines()
            if told is not None:
                assert lines == told
            else:
                assert lines[0].startswith("open False ")
                assert lines[1] == f"pool True {lines[0].split()[-1]}"
            assert "Traceback" not in run.stderr
            assert list(namespace.at(shared.PLACE).iterdir()) == []
