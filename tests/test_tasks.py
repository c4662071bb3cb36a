"""Tasks and actions as types: what travels, what is refused, what a third party can add."""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import pytest
from executive_rig import robot
from spelled import asked

from cocoro import topics
from cocoro.entry_points import Added, EntryPoints
from cocoro.messages import Intent, TaskRequest
from cocoro.messages.actions import ACTIONS, TASK_GROUP, Action
from cocoro.tasks import Skills, Task
from cocoro.testing import in_virtual_time
from services.executive.tasks import TASKS, FetchTask
from services.planning.behaviours import BEHAVIOURS, behaviour_for


class Hop(Action, frozen=True, tag="hop"):
    height_m: float

    def behaviour(self) -> str:
        return f"hopping {self.height_m} m"


class Stumble(Action, frozen=True, tag="stumble"):
    """An action without a behaviour."""


class HopTask(Task, frozen=True, kw_only=True, tag="hop"):
    """Hop."""

    brings: ClassVar[tuple[type[Action], ...]] = (Hop, Stumble)

    async def run(self, skills: Skills) -> None:
        await skills.do(Hop(0.1), timeout_s=1.0)


@pytest.fixture
def third_party(monkeypatch: pytest.MonkeyPatch) -> None:
    """A distribution that adds a task with an action of its own, one that is no task, and one that cannot be loaded."""
    added = (Added("hop", HopTask, "hopper"), Added("skip", "no task", "hopper"))
    found = {TASK_GROUP: EntryPoints(added, ("entry point 'jump' of jumper cannot be loaded: ImportError: gone",))}
    for module in ("cocoro.tasks", "cocoro.messages.actions", "services.executive.executive"):
        monkeypatch.setattr(f"{module}.added_to", found.__getitem__)


def test_an_action_without_a_behaviour_never_reaches_the_planner(third_party: None) -> None:
    assert "hop" in ACTIONS.all()
    sent = msgspec.msgpack.encode({"action": {"action": "stumble"}})
    with pytest.raises(msgspec.ValidationError, match="unknown action 'stumble'"):
        msgspec.msgpack.decode(sent, type=Intent)


# --- what travels ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", TASKS.own.values(), ids=lambda kind: kind.tag())
def test_a_task_goes_round_unchanged(kind: type[Task]) -> None:
    given = {"label": "red_can", "x_m": 1.0, "y_m": -2.0}
    required = {field.name for field in msgspec.structs.fields(kind) if field.required}
    task = TASKS.read({"task": kind.tag(), **{name: given[name] for name in required}})
    sent = msgspec.msgpack.encode(TaskRequest(task=task))
    assert TASKS.read(msgspec.msgpack.decode(sent, type=TaskRequest).task) == task


def test_every_action_has_a_behaviour() -> None:
    assert set(BEHAVIOURS) == set(ACTIONS.own.values())


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ({"task": "dance"}, "unknown task 'dance'; known are fetch, follow"),
        ({"task": 3}, "unknown task 3"),
        ({}, "unknown task None"),
        ("fetch", "a map is expected, not str"),
        ({"task": "fetch"}, "fetch: .*required field `label`"),
        (
            {"task": "fetch", "label": "red_can", "brng": True},
            "fetch: unknown field 'brng'; known are label, bring; did you mean bring",
        ),
        ({"task": "go-to", "label": "red_can", "distance_m": 9.0}, "go-to: distance_m: .*<= 5"),
        ({"task": "go-there", "x_m": 1.0}, "go-there: .*required field `y_m`"),
        ({"task": "put-down", "x_m": 1.0}, "put-down: a place needs both x and y"),
        ({"task": "babble-arm", "count": "many"}, "babble-arm: count: Expected `int`"),
    ],
)
def test_what_is_no_task_is_refused_by_name(data: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        TASKS.read(data)


@in_virtual_time
async def test_the_executive_refuses_a_bad_request_and_says_what_is_wrong() -> None:
    async with robot() as it:
        unknown = await it.service.ask(topics.RUN, asked("dance"))
        assert (unknown.accepted, unknown.refusal) == (False, "bad_request")
        assert "dance" in unknown.text
        assert all(name in unknown.text for name in TASKS.own)
        wrong = await it.service.ask(topics.RUN, asked("follow", "red_can", for_s=-1.0))
        assert wrong.refusal == "bad_request"
        assert "for_s" in wrong.text
        assert (await it.ask()).accepted


@pytest.mark.parametrize("action", [None, "idle", {"action": "dance"}, {"action": "search"}, {"label": "red_can"}])
def test_an_intent_without_a_good_action_is_refused_where_it_is_decoded(action: Any) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.msgpack.decode(msgspec.msgpack.encode({"action": action}), type=Intent)


# --- third parties --------------------------------------------------------------------------------


def test_a_third_partys_task_and_action_are_read_like_ours(third_party: None) -> None:
    assert TASKS.read({"task": "hop"}) == HopTask()
    intent = msgspec.msgpack.decode(msgspec.msgpack.encode(Intent(action=Hop(0.2))), type=Intent)
    assert intent.action == Hop(0.2)
    assert behaviour_for(intent.action) == "hopping 0.2 m"  # type: ignore[comparison-overlap]
    assert TASKS.kind("fetch") is FetchTask


@in_virtual_time
async def test_a_third_partys_task_runs_and_one_that_cannot_be_loaded_is_named(third_party: None) -> None:
    async with robot() as it:
        await it.begin("hop", "")
        assert (await it.outcome()).outcome == "done"
        assert "hop" in it.asked
        refused = await it.ask("jump", "")
        assert "jumper" in refused.text
