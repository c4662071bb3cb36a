"""The process table, and how its rows become components."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from operator_shell import install_parts

from cocoro.component import Process
from cocoro.component import load as load_component
from cocoro.errors import ConfigError
from cocoro.topics import REQUESTS, TOPICS
from deploy import processes, profiles
from deploy.processes import PROCESSES


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A third party's distribution, installed."""
    install_parts(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    processes.table.cache_clear()
    yield tmp_path
    processes.table.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "parts"]:
        del sys.modules[name]


def row(module: str) -> Process:
    return Process(name="thing", module=module, services=("thing",), doc="")


def test_names_are_unique_and_each_row_stands_for_something() -> None:
    assert len({process.name for process in PROCESSES}) == len(PROCESSES)
    assert all(process.services and process.doc for process in PROCESSES)


def test_every_publisher_and_server_on_the_mesh_has_a_process() -> None:
    services = {service for process in PROCESSES for service in process.services} | {"sim"}
    named = {topic.publisher for topic in TOPICS} | {request.server for request in REQUESTS}
    assert named - {"*"} <= services


@pytest.mark.parametrize("process", profiles.read("sim").rows(), ids=lambda process: process.name)
def test_a_component_of_the_simulated_robot_starts_with_nothing_configured(process: Process) -> None:
    component = load_component(process)
    config = component.config()
    assert msgspec.convert({}, component.config) == config
    with pytest.raises(msgspec.ValidationError, match="unknown field"):
        msgspec.convert({"no_such_field": 1}, component.config)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"no process 'percepton'; known are sim, kinect, .*perception"):
        processes.named("percepton")


def test_third_parties_add_rows_by_entry_point(parts: Path) -> None:
    assert processes.named("good").services == ("good",)
    assert load_component(processes.named("good")).config().pace_hz == 1.0


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("planning = parts:good", r"'planning' of parts: there is a process of that name already"),
        ("fine = parts:good", r"'fine' of parts: parts:good is not a Process named 'fine'"),
        ("fine = parts:nothing", r"'fine' of parts cannot be loaded: AttributeError"),
    ],
)
def test_a_bad_entry_point_is_named(parts: Path, entry: str, message: str) -> None:
    (parts / "parts-1.0.dist-info" / "entry_points.txt").write_text(f"[deploy.processes]\n{entry}\n")
    with pytest.raises(ConfigError, match=message):
        processes.table()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"process thing: there is no module component"),
        ("async def run(node, config): ...", r"component has no Config"),
        ("import msgspec\nclass Config(msgspec.Struct): ...\ndef run(node, config): ...", r"no `async def run"),
    ],
)
def test_a_module_that_is_no_component_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, message: str
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "component", raising=False)
    if text is not None:
        (tmp_path / "component.py").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_component(row("component"))


def test_a_missing_library_of_a_component_is_not_taken_for_a_missing_component(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "needy.py").write_text("import a_library_that_is_not_there")
    with pytest.raises(ModuleNotFoundError, match="a_library_that_is_not_there"):
        load_component(row("needy"))
