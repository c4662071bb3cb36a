"""The cockpit of a robot of processes: its address, a page that looks, has it park, and stops it."""

from __future__ import annotations

import json
import re
import struct
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import operator_shell
import pytest
from operator_shell import Shell
from websockets.sync.client import ClientConnection, connect

from apps.cli import exits
from deploy.processes import stoppable

pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]

PATIENCE_S = 60.0
UP = ("up", "sim", "--detach", "--frames", "320x240@15", "--set", "service.cockpit.port=0")


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shell]:
    monkeypatch.setattr(operator_shell, "PATIENCE_S", 300.0)  # a busy machine simulates slowly
    with Shell(tmp_path) as shell:
        yield shell


class LivePage:
    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket

    def say(self, do: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"do": do, **fields}))

    def until(self, wanted: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """The next message that is wanted; a picture is one of the kind `picture`. It is acknowledged."""
        while True:
            data = self._socket.recv(timeout=PATIENCE_S)
            if isinstance(data, bytes):
                (length,) = struct.unpack_from("<I", data)
                message = json.loads(data[4 : 4 + length]) | {"kind": "picture", "jpeg": data[4 + length :]}
                self.say("seen", stamp_ns=message["stamp_ns"])
            else:
                message = json.loads(data)
            if wanted(message):
                return dict(message)


def test_a_page_looks_at_the_robot_has_it_park_and_stops_it(shell: Shell) -> None:
    up = shell(*UP)
    assert up.returncode == exits.DONE, up.stdout + up.stderr
    found = re.search(r"^cockpit: (http://127\.0\.0\.1:(\d+)/)$", up.stdout, re.MULTILINE)
    assert found, up.stdout
    with urllib.request.urlopen(found[1], timeout=PATIENCE_S) as page:
        assert b"<html" in page.read()

    with connect(f"ws://127.0.0.1:{found[2]}/live", compression=None, max_size=None) as socket:
        it = LivePage(socket)
        hello = it.until(lambda message: message["kind"] == "hello" and message["tasks"])
        assert {"fetch", "park", "drive"} <= {task["name"] for task in hello["tasks"]}
        picture = it.until(lambda message: message["kind"] == "picture" and message["width"] == 320)
        assert picture["jpeg"].startswith(b"\xff\xd8")

        it.say("run", id="park", task={"task": "park"})
        reply = it.until(lambda message: message["kind"] == "reply" and message["id"] == "park")
        assert reply["ok"], reply["text"]
        done = it.until(lambda message: message["kind"] == "state" and message["task"]["outcome"])
        assert (done["task"]["task"], done["task"]["outcome"]) == ("park", "done")

        it.say("stop", id="stop")
        stopped = it.until(lambda message: message["kind"] == "stopped" and message["final"])
        assert {*stopped["acknowledged"]} >= {*stoppable(), "executive"}
        assert (stopped["missing"], stopped["trouble"]) == ([], "")
        it.until(lambda message: message["kind"] == "state" and message["latch"] == "latched")
        it.say("reset", id="reset")
        assert it.until(lambda message: message["kind"] == "reply" and message["id"] == "reset")["ok"]

    assert shell("down").returncode == exits.DONE


def test_a_robot_without_a_cockpit_says_nothing_of_it(shell: Shell) -> None:
    up = shell("up", "sim", "--detach", "--no-cockpit", "--frames", "320x240@15")
    assert up.returncode == exits.DONE, up.stdout + up.stderr
    assert "cockpit" not in up.stdout
    assert "cockpit" not in shell("status").stdout
    assert shell("down").returncode == exits.DONE
