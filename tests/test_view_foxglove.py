"""A robot live in Foxglove: what is shown, and what may be asked."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")

from foxglove_rig import ROBOT, serving
from foxglove_viewer import Viewer

from apps.captures.export.foxglove_layout import layout
from apps.captures.export.foxglove_scene import TOPICS as SHOWN
from apps.captures.export.foxglove_scene import FoxgloveScene
from apps.captures.export.foxglove_server import FoxgloveServer
from apps.cli.main import main
from apps.cli.view_foxglove import Asked
from cocoro.clock import NS
from cocoro.errors import ConfigError, RefusedError
from cocoro.joints import GROUPS
from cocoro.keys import asker_key
from cocoro.messages import (
    BaseState,
    EstopReply,
    FloorPlan,
    Frame,
    PlannerStatus,
    ServoState,
    TaskReply,
    TaskRequest,
)
from cocoro.objects import Catalogue
from cocoro.participant import Answer
from cocoro.topics import Request
from services.executive.tasks import FetchTask

pytestmark = pytest.mark.zenoh  # a server that listens, and its threads: real time


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with serving() as made:
        yield made


def base(stamp_s: float, x_m: float = 0.0) -> BaseState:
    return BaseState(
        stamp_ns=round(stamp_s * NS), odometry_m=(x_m, 0.0), odometry_yaw_rad=0.0, speed_mps=0.0, turn_rate_radps=0.0
    )  # fmt: skip


def frame(stamp_s: float) -> Frame:
    return Frame(
        stamp_ns=round(stamp_s * NS), width=32, height=24, colour=memoryview(bytes(32 * 24 * 3)),
        depth=memoryview(b"\x00\x03" * 32 * 24),
    )  # fmt: skip


class Telling:
    """Tells a server the same messages again and again, as a mesh does, until the test ends."""

    def __init__(self, server: FoxgloveServer, **messages: Any) -> None:
        self._server, self._messages = server, messages
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        stamp_ns = NS
        while not self._over.wait(0.005):
            stamp_ns += NS // 10
            for name, message in self._messages.items():
                message.stamp_ns = stamp_ns
                self._server.log(name.replace("_", "/"), message)

    def __enter__(self) -> Telling:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()


def test_a_viewer_sees_the_robot_its_picture_the_map_and_every_message_as_json(server: FoxgloveServer) -> None:
    plan = FloorPlan(cell_m=0.05, origin_m=(1.0, 2.0), width=2, height=1, cells=b"\x01\x02", goal_m=(3.0, 4.0))
    status = PlannerStatus(why="because", body_m=(0.5, 0.0))
    with Viewer(server.address) as viewer:
        assert set(SHOWN) <= set(viewer.channels)
        assert viewer.channels["/map"]["schemaName"] == "foxglove.Grid"
        assert viewer.channels["ada/base/state"]["schemaEncoding"] == "jsonschema"
        viewer.subscribe("/tf", "/map", "/camera/colour", "/camera/depth", "ada/planning/status", "ada/planning/map")
        with Telling(
            server, base_state=base(1.0), planning_map=plan, kinect_frame=frame(1.0), planning_status=status
        ):  # fmt: skip
            assert b"odometry" in viewer.message("/tf")
            assert b"\xdc\x5a\x3c\xe6" in viewer.message("/map"), "the occupied cell's colour"
            assert b"jpeg" in viewer.message("/camera/colour")
            assert b"16UC1" in viewer.message("/camera/depth")
            assert json.loads(viewer.message("ada/planning/status"))["why"] == "because"
            shown = json.loads(viewer.message("ada/planning/map"))
            assert (shown["cells"], shown["goal_m"]) == ("2 bytes", [3.0, 4.0])


def test_what_nobody_wants_is_not_made() -> None:
    scene = FoxgloveScene(ROBOT, Catalogue.load(), wanted=lambda topic: topic == "/camera/depth", depth=True)
    assert [shown.topic for shown in scene.of(frame(1.0))] == ["/camera/calibration", "/camera/depth"]


def test_who_comes_late_gets_the_chassis_too() -> None:
    scene = FoxgloveScene(ROBOT, Catalogue.load(), again_ns=NS)
    shown = [made.topic for n in range(25) for made in scene.of(base(1.0 + n / 10))]
    assert shown.count("/robot/chassis") == 3


def test_the_map_stays_where_the_planner_has_it_when_a_search_has_corrected_the_odometry() -> None:
    scene = FoxgloveScene(ROBOT, Catalogue.load())
    list(scene.of(base(1.0, x_m=2.0)))
    (moved, _) = scene.of(PlannerStatus(stamp_ns=NS, body_m=(2.5, 0.0)))
    assert moved.topic == "/tf"
    encoded = moved.message.encode()
    assert b"map" in encoded
    assert b"odometry" in encoded
    (believed,) = scene.of(PlannerStatus(stamp_ns=NS + 1, body_m=(2.5, 0.0)))
    assert believed.topic == "/believed"


def test_links_are_drawn_once_every_joint_is_known() -> None:
    scene = FoxgloveScene(ROBOT, Catalogue.load())
    for group in GROUPS:
        joints = ROBOT.group_joints(group)
        zeros = (0.0,) * len(joints)
        shown = list(scene.of(ServoState(joints=joints, position_rad=zeros, speed_radps=zeros, load=zeros)))
    assert [made.topic for made in shown] == ["/tf", "/robot/links"]


def test_a_service_answers_or_says_what_is_wrong(server: FoxgloveServer) -> None:
    with Viewer(server.address) as viewer:
        assert viewer.ask("/task/fetch", label="red_can") == {"accepted": True, "label": "red_can"}
        assert "label" in viewer.services["/task/fetch"]["request"]["schema"]
        with pytest.raises(RuntimeError, match="label is missing"):
            viewer.ask("/task/fetch")


def test_a_clock_that_begins_anew_begins_a_new_session(server: FoxgloveServer) -> None:
    with Viewer(server.address) as viewer:
        server.log("base/state", base(100.0))
        server.log("base/state", base(1.0))
        while True:
            kind, content = viewer.next()
            if kind == 1 and json.loads(content)["op"] == "serverInfo":
                return


def test_a_port_that_is_taken_is_told_with_what_to_do(server: FoxgloveServer) -> None:
    with pytest.raises(ConfigError, match=f"127.0.0.1:{server.port}.*give another --port"):
        FoxgloveServer("ada", ROBOT, Catalogue.load(), [], host="127.0.0.1", port=server.port)


# --- what is asked of the robot ---------------------------------------------------------------------


class Mesh:
    """A robot's mesh as the services use it: notes what is asked, and gives the answers of a script."""

    robot = "ada"

    def __init__(self, *, refuses: bool = False) -> None:
        self.bus = self
        self.tokens: list[str] = []
        self.asked: list[object] = []
        self._refuses = refuses
        self._slow = {"arm"}

    def new_incarnation(self) -> int:
        return 7

    def declare_alive(self, key: str) -> Mesh:
        self.tokens.append(key)
        return self

    def close(self) -> None:
        self.tokens.clear()

    async def alive(self) -> list[str]:
        return ["base", "arm", "hand", "executive"]

    async def call(self, request: Request[Any, Any], question: object) -> TaskReply:
        if self._refuses:
            raise RefusedError(f"your role viewer may not ask {request.name}")
        self.asked.append(question)
        return TaskReply(accepted=True, task_id="t1")

    async def call_all(self, _: Request[Any, Any], question: object) -> list[Answer[EstopReply]]:
        """At the first time the arm does not answer."""
        self.asked.append(question)
        silent, self._slow = self._slow, set()
        return [
            Answer(name, EstopReply(service=name, latch="latched"), "")
            for name in ("base", "arm", "hand")
            if name not in silent
        ]


def asked(mesh: Mesh, work: Callable[[Asked], Any]) -> Any:
    """The result of what is asked in a thread of a server, while the loop of the mesh runs."""

    async def run() -> Any:
        asking = Asked(mesh, asyncio.get_running_loop(), local=False)  # type: ignore[arg-type]
        try:
            return await asyncio.to_thread(work, asking)
        finally:
            asking.close()

    return asyncio.run(run())


def test_a_stop_is_asked_again_until_all_that_move_have_acknowledged_it() -> None:
    mesh = Mesh()
    assert asked(mesh, lambda ask: ask.stop({})) == {"acknowledged": ["arm", "base", "hand"], "missing": []}
    assert len(mesh.asked) == 2


def test_a_task_ends_with_the_command_that_serves_it() -> None:
    mesh = Mesh()

    def begin(ask: Asked) -> tuple[Any, list[str]]:
        return ask.run("fetch", {"label": "red_can", "bring": True}), list(mesh.tokens)

    reply, tokens = asked(mesh, begin)
    (request,) = mesh.asked
    assert isinstance(request, TaskRequest)
    assert (reply["accepted"], reply["task_id"]) == (True, "t1")
    assert request.task == FetchTask(label="red_can", bring=True)
    assert tokens == [asker_key("ada", request.asker)]
    assert mesh.tokens == []


def test_who_may_only_look_is_told_so_and_a_bad_task_is_named() -> None:
    with pytest.raises(RefusedError, match="may not ask executive/run"):
        asked(Mesh(refuses=True), lambda ask: ask.run("park", {}))
    with pytest.raises(ValueError, match="unknown field 'brng'"):
        asked(Mesh(), lambda ask: ask.run("fetch", {"label": "red_can", "brng": True}))


def test_tasks_are_offered_to_who_asked_for_that_alone() -> None:
    names = asked(Mesh(), lambda ask: [[one.name for one in ask.services(operate=may)] for may in (False, True)])
    assert names[0] == ["/stop"]
    assert {"/stop", "/cancel", "/task/fetch", "/task/go-there", "/task/park"} <= set(names[1])
    assert "/task/babble-arm" not in names[1]


# --- the command ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--foxglove", "--operate", "--bind", "0.0.0.0"], "ssh -L"),
        (["--foxglove", "--web", "--sim"], "leave out --sim, --web"),
        (["--port", "9000"], "give that, too"),
    ],
)
def test_what_makes_no_sense_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    assert main(["view", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_the_layout_shows_topics_and_asks_services_that_are_there() -> None:
    text = layout("calliope")
    page = Path(__file__).parents[1] / "docs" / "foxglove-layout.json"
    assert page.read_text(encoding="utf-8") == text + "\n", "python -m apps.captures.export.foxglove_layout > it"
    whole = json.dumps(json.loads(text))
    for name in ("/camera/colour", "/camera/annotations", "/map", "/planned", "/camera/points", "/log"):
        assert name in SHOWN
        assert name in whole
    assert "calliope/planning/status.why" in whole
    assert "ada/base/state.speed_mps" in layout("ada")
