"""A third party's component, installed: its topics are checked, listed, recorded, exported, replayed and its core is
re-executed as the project's own are."""

from __future__ import annotations

import asyncio
import csv
import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import pytest
from capture_rig import STILL, Room, all_of, record
from third_party import NAME, forget_third_parties, install, on_path

from apps.captures.reexecute import reexecute
from apps.captures.replay import Replay, played_keys
from apps.cli.echo import read
from apps.cli.listening import takes_frames
from apps.cli.main import main
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.capture.player import Player
from cocoro.capture.reader import Capture
from cocoro.component import Component, load
from cocoro.errors import ConfigError
from cocoro.installed import topic_named
from cocoro.messages import BaseState, Message
from cocoro.robot import Robot
from cocoro.topics import Topic
from deploy import processes

pytestmark = pytest.mark.process  # pip installs the distribution

KEY = f"calliope/{NAME}/travelled"


@pytest.fixture(scope="module")
def odometer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Component]:
    """The component, as it is installed."""
    with on_path(install(tmp_path_factory.mktemp("third"))):
        yield processes.named(NAME)


@pytest.fixture(scope="module")
def rejected(odometer: Component, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Record two seconds with an invalid message: "path" is the capture, "health" what a reader made of it."""
    implementation, found = load(odometer), {}

    async def scenario(room: Room) -> None:
        config = implementation.config(rate_hz=10.0)
        node = room.node(NAME, module=odometer.module, config=config, record_steps=True)
        async with node, room.node("viewer") as viewer, room.node("base") as base:
            viewer.latest(travelled())
            running = asyncio.ensure_future(implementation.run(node, config))
            for tick in range(100):
                base.publish(topics.BASE_STATE, BaseState(odometry_m=(tick / 50, 0.0), **STILL))
                await asyncio.sleep(0.02)
            bad = msgspec.msgpack.encode({"distance_m": -1.0, "seq": 99})
            room.mesh.join().publisher(KEY, Qos.STATE).put(bad)
            await asyncio.sleep(0.1)
            found["health"] = viewer.inbox(travelled()).health(viewer.now_ns())
            running.cancel()
            with suppress(asyncio.CancelledError):
                await running

    path = tmp_path_factory.mktemp("capture") / "odometer.mcap"
    return {"path": record(path, scenario)} | found


def travelled() -> Topic[Any]:
    topic = topic_named(f"{NAME}/travelled")
    assert topic is not None
    return topic


def test_it_is_listed(odometer: Component, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topics", "--json"]) == 0
    row = next(row for row in json.loads(capsys.readouterr().out) if row["topic"] == f"{NAME}/travelled")
    assert (row["type"], row["publisher"], row["rate_hz"], row["recorded"]) == ("Travelled", NAME, 2.0, True)
    assert main(["topics"]) == 0
    assert f"{NAME}/scratch" in capsys.readouterr().out
    assert main(["topics", "--markdown"]) == 0
    assert NAME not in capsys.readouterr().out  # the page of the documentation has the project's own alone
    assert NAME in processes.readers(topics.BASE_STATE)


def test_a_message_that_is_not_valid_is_rejected_counted_and_shown(rejected: dict[str, Any]) -> None:
    health = rejected["health"]
    assert health.count >= 19
    assert health.rejected == 1
    assert "distance_m" in health.last_error
    good, bad = (read(msgspec.msgpack.encode({"distance_m": d}), f"{NAME}/travelled") for d in (1.0, -1.0))
    assert (good.type, good.problem) == ("Travelled", "")
    assert (bad.type, "distance_m" in bad.problem) == ("Travelled", True)
    assert not takes_frames(f"{NAME}/travelled")


def test_it_is_recorded_with_its_schema_and_read_as_its_type(rejected: dict[str, Any]) -> None:
    with Capture.open(rejected["path"]) as capture:
        (channel,) = capture.keys[KEY]
        schema = capture.schema(channel)
        assert schema is not None
        assert schema.name == "Travelled"
        assert set(json.loads(schema.data)["properties"]) == {"stamp_ns", "seq", "incarnation", "distance_m"}
        assert capture.channels[channel].metadata == {"publisher": NAME, "qos": "state", "rate_hz": "2"}
        message = capture.read(next(iter(capture.messages(KEY))))
        assert type(message) is travelled().type


def test_a_topic_that_is_declared_so_is_not_recorded(rejected: dict[str, Any]) -> None:
    with Capture.open(rejected["path"]) as capture:
        assert f"calliope/{NAME}/scratch" not in capture.keys
        assert KEY in capture.keys


def test_record_reports_what_is_not_recorded(
    odometer: Component, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--out", str(tmp_path)]) == 4  # there is no robot in this run directory
    assert f"not recorded, as declared: {NAME}/scratch\n" in capsys.readouterr().err


def test_it_is_exported(rejected: dict[str, Any], tmp_path: Path) -> None:
    assert main(["export", str(rejected["path"]), "--csv", str(tmp_path)]) == 0
    with (tmp_path / f"{NAME}_travelled.csv").open() as table:
        distances = [float(row["distance_m"]) for row in csv.DictReader(table)]
    assert 1.9 < max(distances) < 2.0


def test_it_is_exported_to_foxglove(rejected: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    assert main(["export", str(rejected["path"]), "--foxglove", str(tmp_path / "f.mcap")]) == 0
    with Capture.open(tmp_path / "f.mcap") as exported:
        (channel,) = exported.keys[KEY]
        schema = exported.schema(channel)
        assert schema is not None
        assert schema.name == "Travelled"


def test_it_is_replayed(rejected: dict[str, Any], tmp_path: Path) -> None:
    async def play(room: Room) -> None:
        with Capture.open(rejected["path"]) as capture:
            keys = played_keys(capture, (), False)
            await Replay(room.mesh.join(), capture, Player(capture, keys.__contains__)).run()

    again = record(tmp_path / "again.mcap", play)
    payloads = [[bytes(each.payload) for each in all_of(path, KEY)] for path in (rejected["path"], again)]
    assert payloads[0] == payloads[1]
    assert len(payloads[0]) >= 20


def test_its_core_is_executed_again(rejected: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    module = import_module(f"{NAME}.service")
    with Capture.open(rejected["path"]) as capture:
        result = reexecute([capture], NAME)
        assert result.steps == result.equal == result.outputs >= 19  # an output that is not recorded is not compared
        make = module.implementation.core

        def unlike(robot: Robot, config: Any) -> Any:
            return make(robot, type(config)(least_move_m=0.03))

        monkeypatch.setattr(module, "implementation", replace(module.implementation, core=unlike))
        assert reexecute([capture], NAME).differing > 0


# --- names that collide ---------------------------------------------------------------------------


class Other(Message):
    """Another message."""


@pytest.mark.parametrize("name", ["base/state", "odometer/health"])
def test_a_topic_of_a_taken_name_is_an_error_and_does_not_disturb(
    odometer: Component, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    clash = Topic(name, Other, Qos.STATE, 1.0, 3.0, "Clashes.")
    monkeypatch.setattr(import_module(NAME), "component", replace(odometer, publishes=(clash,)))
    forget_third_parties()
    try:
        with pytest.raises(ConfigError, match=rf"'{NAME}' of cocoro-{NAME}: its topic {name} differs from the one"):
            processes.named(NAME)
        known = topic_named(name)
        assert known is not None
        assert known.type is not Other
        assert NAME not in {component.name for component in processes.components()}
        assert main(["topics"]) == 0
    finally:
        forget_third_parties()
