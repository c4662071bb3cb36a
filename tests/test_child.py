"""Child processes: messages both ways, their end noticed, a hanging one killed."""

from __future__ import annotations

import asyncio
import signal
import subprocess
from pathlib import Path

import pytest

from cocoro.child import ChildProcess, wait_or_kill

pytestmark = pytest.mark.process

ECHO = """
import socket, sys
channel = socket.socket(fileno=int(sys.argv[-1]))
channel.send(sys.argv[1].encode())
while message := channel.recv(100):
    channel.send(message[::-1])
"""
DEAF = "import time\ntime.sleep(600)\n"
BARE = "import sys\nsys.exit(any('site-packages' in path for path in sys.path))\n"


@pytest.fixture
def modules(tmp_path: Path) -> str:
    for name, text in {"echo_child": ECHO, "deaf_child": DEAF, "bare_child": BARE}.items():
        (tmp_path / f"{name}.py").write_text(text)
    return str(tmp_path)


def test_messages_travel_both_ways_and_the_end_of_the_child_is_noticed_once(modules: str) -> None:
    async def scenario() -> tuple[list[bytes], int]:
        received: list[bytes] = []
        closed = 0
        ended = asyncio.Event()
        child = ChildProcess("echo_child", "hello", packages=(modules,))

        def on_message(message: bytes) -> None:
            received.append(message)
            if message == b"hello":
                assert child.send(b"abc")
            else:
                child.process.kill()

        def on_closed() -> None:
            nonlocal closed
            closed += 1
            ended.set()

        child.watch(on_message, on_closed)
        async with asyncio.timeout(30.0):
            await ended.wait()
        child.read()
        wait_or_kill(child.process, 30.0)
        return received, closed

    assert asyncio.run(scenario()) == ([b"hello", b"cba"], 1)


def test_a_child_ends_when_the_channel_is_closed(modules: str) -> None:
    child = ChildProcess("echo_child", "hello", packages=(modules,))
    child.close()
    wait_or_kill(child.process, 30.0)
    assert child.process.returncode in (0, 1)  # 1: it was not up yet, and could not say hello
    assert not child.send(b"late")


def test_a_child_that_hangs_is_killed(modules: str) -> None:
    child = ChildProcess("deaf_child", packages=(modules,), stdout=subprocess.PIPE)
    child.close()
    wait_or_kill(child.process, 0.05)
    assert child.process.returncode == -signal.SIGKILL
    assert child.process.stdout is not None
    assert child.process.stdout.closed


def test_without_site_packages_only_the_named_folders_are_searched(modules: str) -> None:
    child = ChildProcess("bare_child", packages=(modules,), site_packages=False)
    child.close()
    wait_or_kill(child.process, 30.0)
    assert child.process.returncode == 0
