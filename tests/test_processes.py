"""The union of components: what is declared, what is derived from it, and how a declaration becomes what runs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from operator_shell import install_parts

from cocoro import topics
from cocoro.component import Component
from cocoro.component import load as load_component
from cocoro.entry_points import added_to
from cocoro.errors import ConfigError
from cocoro.installed import third_parties
from cocoro.messages import Message
from cocoro.stop import asking
from cocoro.topics import REQUESTS, TOPICS, Topic
from deploy import processes, profiles
from deploy.processes import COMPONENTS
from deploy.site.component import GATEWAY

NODES = (topics.HEALTH, topics.STEPS, topics.EXCHANGES)
"""Published by every node, whatever runs in it."""


def forget() -> None:
    """Have third parties looked for anew."""
    processes.table.cache_clear()
    third_parties.cache_clear()
    added_to.cache_clear()


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A third party's distribution, installed."""
    install_parts(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    forget()
    yield tmp_path
    forget()
    for name in [name for name in sys.modules if name.partition(".")[0] == "parts"]:
        del sys.modules[name]


IMPORTS = "import msgspec\nfrom cocoro.component import Implementation\nclass C(msgspec.Struct): ...\n"


def thing(module: str) -> Component:
    return Component(name="thing", module=module, doc="")


# --- the declarations -----------------------------------------------------------------------------


def test_names_are_unique_and_each_component_stands_for_something() -> None:
    assert len({component.name for component in COMPONENTS}) == len(COMPONENTS)
    assert len({component.module for component in COMPONENTS}) == len(COMPONENTS)
    assert all(component.services and component.doc for component in COMPONENTS)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_topic_is_published_by_a_component_under_the_name_that_it_says(topic: Topic[Message]) -> None:
    declared = any(one.name == topic.name for component in COMPONENTS for one in component.publishes)
    assert declared != (topic in NODES)
    assert topic.publisher in processes.publishers(topic)


def test_every_request_is_served_by_a_component() -> None:
    served = {one.name for component in COMPONENTS for one in component.all_serves()}
    for request in REQUESTS:
        if request is not topics.ABOUT:  # by every node
            assert request.name in served or any(
                request.of(name).name in served for name in (*processes.stoppable(), GATEWAY.name)
            )


def test_what_a_component_needs_it_hears_of_by_a_topic_that_it_reads() -> None:
    for component in COMPONENTS:
        heard = {publisher for topic in component.reads for publisher in processes.publishers(topic)}
        assert set(component.needs) <= heard, component.name


def test_a_component_that_moves_something_answers_the_emergency_stop() -> None:
    with pytest.raises(ConfigError, match=r"component gripper: gripper moves something, so it must serve STOPS"):
        Component(name="gripper", module="gripper", doc="", moves=("gripper",))
    with pytest.raises(ConfigError, match=r"component gripper: gripper moves something, so it must serve STOPS"):
        Component(name="gripper", module="gripper", doc="", moves=("gripper",), serves=(topics.ESTOP,))
    with pytest.raises(ConfigError, match=r"component gripper: it moves claw, which is none of its services"):
        Component(name="gripper", module="gripper", doc="", moves=("claw",), serves=topics.STOPS)
    assert Component(name="gripper", module="gripper", doc="", moves=("gripper",), serves=topics.STOPS).moves


# --- what is derived ------------------------------------------------------------------------------


def test_hardware_and_what_the_emergency_stop_stops_are_derived() -> None:
    assert processes.hardware() == ("kinect", "base", "arm", "hand")
    assert processes.stoppable() == ("base", "arm", "hand")
    assert processes.stoppable() == asking.STOPPABLE  # which imports nothing, so it has its own
    assert {*processes.hardware()} == {*processes.named("sim").services}


def test_what_the_executive_needs_is_derived_from_what_each_component_needs() -> None:
    six = ("kinect", "base", "arm", "hand", "perception", "planning")
    for name in ("sim", "sim-wire", "robot", "replay"):
        assert processes.needs("executive", profiles.read(name).rows()) == six
    assert processes.needs("executive") == six
    assert processes.needs("kinect") == ()
    other = Component(name="other", module="x", doc="", services=("planning",), needs=("lidar", "executive"))
    assert processes.needs("executive", [other]) == ("base", "arm", "hand", "planning", "lidar")


def test_who_publishes_a_topic_is_derived() -> None:
    assert processes.publishers(topics.BASE_COMMAND) == ("planning",)
    assert processes.publishers(topics.BASE_STATE) == ("base",)
    assert processes.publishers(topics.CLOCK) == ("sim", "wire")
    assert processes.publishers(topics.HEALTH) == ("*",)


# --- the implementations --------------------------------------------------------------------------


@pytest.mark.parametrize("process", COMPONENTS, ids=lambda process: process.name)
def test_a_component_starts_with_nothing_configured(process: Component) -> None:
    component = load_component(process)
    config = component.config()
    assert msgspec.convert({}, component.config) == config
    with pytest.raises(msgspec.ValidationError, match="unknown field"):
        msgspec.convert({"no_such_field": 1}, component.config)
    assert not {*component.config.__struct_fields__} & {*profiles.Launch.__struct_fields__}, "every component has these"


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"no process 'percepton'; known are sim, kinect, .*perception"):
        processes.named("percepton")


def test_third_parties_add_rows_by_entry_point(parts: Path) -> None:
    assert processes.named("good").services == ("good",)
    assert load_component(processes.named("good")).config().pace_hz == 1.0


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("planning = parts:planning", r"parts.good of a third party: there is a component named 'planning' already"),
        ("fine = parts:good", r"'fine' of parts: its value is not a Component named 'fine'"),
        ("fine = parts:nothing", r"'fine' of parts cannot be loaded: AttributeError"),
        ("fine = this_exits:good", r"'fine' of parts cannot be loaded: SystemExit: 3"),
    ],
)
def test_a_bad_entry_point_is_named(parts: Path, entry: str, message: str) -> None:
    (parts / "this_exits.py").write_text("raise SystemExit(3)")
    (parts / "parts-1.0.dist-info" / "entry_points.txt").write_text(f"[cocoro.components]\n{entry}\n")
    with pytest.raises(ConfigError, match=message):
        processes.table()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"component thing: there is no module component"),
        ("async def run(node, config): ...", r"component has no `implementation = Implementation\(CONFIG, run\)`"),
        (f"{IMPORTS}implementation = Implementation(int, print)", r"config is no class of msgspec.Struct"),
        (f"{IMPORTS}implementation = Implementation(C, print)", r"run is no `async def run\(node, config\)`"),
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
        load_component(thing("component"))


def test_a_missing_library_of_a_component_is_not_taken_for_a_missing_component(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "needy.py").write_text("import a_library_that_is_not_there")
    with pytest.raises(ModuleNotFoundError, match="a_library_that_is_not_there"):
        load_component(thing("needy"))
