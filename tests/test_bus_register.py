"""The register of a mesh with rubbish in it, in a place that takes no more, and with a crowd at its sockets."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from zenoh_rig import PATIENCE_S, child, left_in, local, scenario, who

from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.register import Membership, members, new_identity
from cocoro.bus.session import ACCEPT_PENDING
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import ConfigError

CROWD = 200
"""Connections to each socket that say nothing."""
DELAY_S = 1.0
"""By how much such a crowd may delay a new session; it delays none by what is measurable, the rest is for a busy
machine."""


# --- entries that are none ----------------------------------------------------------------------------


def corrupt(path: Path) -> None:
    path.write_bytes(b'{"name": "executive", "pi')


def binary(path: Path) -> None:
    path.write_bytes(os.urandom(64))


def nested(path: Path) -> None:
    path.write_bytes(b"[" * 100_000)


def wrong(path: Path) -> None:
    path.write_bytes(b'{"name": 7, "pid": "none"}')


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 34)


def unreadable(path: Path) -> None:
    path.write_bytes(b"")
    path.chmod(0)


def foreign(path: Path) -> None:
    path.write_bytes(b'{"name": "his", "pid": 1}')
    os.chown(path, 65534, 65534)


def fifo(path: Path) -> None:
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.mkdir()


def link(path: Path) -> None:
    path.symlink_to("/dev/zero")


RUBBISH = (corrupt, binary, nested, wrong, huge, foreign, fifo, folder, link)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Held by a process of this user's, as a member's entry is."""
    with ExitStack() as stack:
        try:
            fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        except OSError:
            fd = None
        if fd is not None:
            stack.callback(os.close, fd)
            fcntl.flock(fd, fcntl.LOCK_EX)
        yield


@pytest.mark.parametrize("plant", [pytest.param(plant, id=plant.__name__) for plant in RUBBISH])
def test_rubbish_that_is_held_is_no_member(directory: Path, plant: Callable[[Path], None]) -> None:
    if plant is foreign and os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    one = Membership.register(directory, "one")
    entry = directory / f"{new_identity()}.member"
    plant(entry)
    with locked(entry):
        assert [member.name for member in members(directory)] == ["one"]
        two = Membership.register(directory, "two")
        assert [other.name for other in two.others] == ["one"]
    two.leave()
    one.leave()


@pytest.mark.parametrize("plant", [corrupt, nested, huge, unreadable])
def test_rubbish_that_nobody_holds_is_tidied_away(directory: Path, plant: Callable[[Path], None]) -> None:
    if plant is unreadable and os.geteuid() != 0:
        pytest.skip("only root reads what may not be read")
    Membership.register(directory, "one").leave()
    plant(directory / f"{new_identity()}.member")
    assert members(directory) == []
    assert left_in(directory) == ["lock"]


def test_what_is_not_named_as_an_entry_is_none(directory: Path) -> None:
    one = Membership.register(directory, "one")
    for name in ("x.member", "../x.member", "0123456789ABCDEF.member", f"{new_identity()}.member.old"):
        if "/" not in name:
            corrupt(directory / name)
    with locked(directory / "x.member"):
        assert [member.name for member in members(directory)] == ["one"]
    assert (directory / "x.member").exists()
    one.leave()


@scenario
async def test_a_mesh_with_rubbish_in_its_directory_is_joined_all_the_same(directory: Path) -> None:
    async with await ZenohBus.open(local(directory, "server")) as server:
        server.serve("robot/server/who", answer)
        with ExitStack() as stack:
            for plant in RUBBISH:
                entry = directory / f"{new_identity()}.member"
                if plant is not foreign or os.geteuid() == 0:
                    plant(entry)
                    stack.enter_context(locked(entry))
            async with await ZenohBus.open(local(directory), expect_mesh=True) as late:
                assert await who(late) == ["server"]


async def answer(_key: str, _payload: bytes | memoryview) -> bytes:
    return b"server"


# --- a place that takes no more -----------------------------------------------------------------------


@pytest.fixture
def takes_no_entries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no entry be made, as in a place without inodes, or in one that was mounted for reading alone."""
    really = os.open

    def open_(path: str, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        if flags & os.O_CREAT:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
        return really(path, flags, mode, dir_fd=dir_fd)

    monkeypatch.setattr(os, "open", open_)


@pytest.mark.process
@scenario
async def test_a_command_needs_no_room_in_a_full_directory(
    directory: Path, request: pytest.FixtureRequest, caplog: pytest.LogCaptureFixture
) -> None:
    async with child(directory, "base") as base:
        await base.says("ready")
        request.getfixturevalue("takes_no_entries")
        with caplog.at_level(logging.WARNING):
            async with await ZenohBus.open(local(directory), expect_mesh=True) as visitor:
                assert await who(visitor) == ["base"]
                assert [member.name for member in members(directory)] == ["base"]
                assert await visitor.alive("robot/*/alive") == ["robot/base/alive"]
        assert len([record for record in caplog.records if "No space left on device" in record.message]) == 1


@scenario
async def test_a_service_says_in_a_line_what_is_full(directory: Path, request: pytest.FixtureRequest) -> None:
    Membership.register(directory, "one").leave()
    request.getfixturevalue("takes_no_entries")
    with pytest.raises(ConfigError) as raised:
        await ZenohBus.open(local(directory))
    told = str(raised.value)
    assert told.startswith(f"run directory {directory}/")
    assert told.endswith(": No space left on device; make room there, or choose another by COCORO_RUN_DIR")


def test_an_entry_that_has_no_room_for_its_name_is_one(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system that is full still makes empty files."""
    with monkeypatch.context() as patch:

        def write(*_: object) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patch.setattr(os, "pwrite", write)
        one = Membership.register(directory, "one")
    assert [(member.identity, member.name, member.pid) for member in members(directory)] == [
        (one.member.identity, "?", 0)
    ]
    one.leave()
    assert members(directory) == []


# --- a crowd ------------------------------------------------------------------------------------------


@contextmanager
def crowd(directory: Path, count: int) -> Iterator[None]:
    """Open `count` connections to each member's socket that send nothing."""
    with ExitStack() as stack:
        for path in sorted(directory.glob("*.sock")):
            for _ in range(count):
                idle = stack.enter_context(socket.socket(socket.AF_UNIX))
                idle.connect(str(path))
        yield


async def joining_s(config: ZenohConfig) -> float:
    """Join and be answered; returns the time that it takes, s."""
    started_s = time.monotonic()
    async with await ZenohBus.open(config, expect_mesh=True) as late:
        assert await who(late) == ["server"]
        return time.monotonic() - started_s


@pytest.mark.process
@scenario
async def test_a_crowd_of_idle_connections_keeps_nobody_out(directory: Path) -> None:
    """The connections do not speak zenoh. The directory is private, so only this user's processes can make such."""
    assert CROWD < ACCEPT_PENDING
    async with child(directory, "server") as server:
        await server.says("ready")
        alone_s = await joining_s(local(directory, patience_s=PATIENCE_S))
        with crowd(directory, CROWD):
            among_many_s = await joining_s(local(directory, patience_s=PATIENCE_S))
        assert among_many_s < alone_s + DELAY_S
        assert await asyncio.wait_for(joining_s(local(directory)), PATIENCE_S) > 0
