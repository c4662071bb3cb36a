"""Rerun's viewer on a capture or live: its window, its page, its address, and what it is given."""

from __future__ import annotations

import subprocess
import sys
import threading
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_rig import ROBOT, Room, drive

from apps.captures.export import rerun_scene
from apps.captures.export.viewer import Attempt, Pulse, Target, ViewerProcess, address_of, free_port, sent
from apps.cli.main import main
from apps.cli.viewed import WAITING, Waiting, watch
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.capture.conventions import CaptureError
from cocoro.errors import ConfigError
from cocoro.messages import BaseCommand, Frame
from cocoro.objects import Catalogue
from cocoro.vloop import run_virtual
from sim.outside import OutsideStage
from sim.scene import load_scene
from sim.world import World

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


class Made:
    """Stands in for any object of Rerun's, and keeps the arguments of its construction."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.args, self.options = args, options

    def __call__(self, *args: Any, **options: Any) -> Made:
        return Made(*args, **options)

    def __getattr__(self, name: str) -> Made:
        if name.startswith("__"):
            raise AttributeError(name)
        return Made()


class Stream:
    """A recording that keeps what is logged, by path."""

    newest: Stream

    def __init__(self, application: str) -> None:
        self.logged: dict[str, list[tuple[float, Any]]] = {}
        self.time_s = -1.0
        self.saved = ""
        Stream.newest = self

    def set_time(self, timeline: str, *, duration: float) -> None:
        assert timeline == rerun_scene.TIMELINE
        self.time_s = duration

    def log(self, path: str, what: Any, static: bool = False) -> None:
        assert " " not in path
        self.logged.setdefault(path, []).append((self.time_s, what))

    def save(self, path: str) -> None:
        self.saved = path

    def flush(self, timeout_sec: float = 0.0) -> None:
        pass

    def send_blueprint(self, blueprint: Any) -> None:
        self.blueprint = blueprint


class FakeRerun(types.ModuleType):
    RecordingStream = Stream

    def __getattr__(self, name: str) -> Made:
        if name.startswith("__"):
            raise AttributeError(name)
        return Made()


def test_rerun_gets_pictures_points_poses_curves_and_phases(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    assert main(["export", str(GOLDEN), "--rrd", str(tmp_path / "out.rrd")]) == 0
    stream = Stream.newest
    logged = stream.logged
    assert stream.saved == str(tmp_path / "out.rrd")
    assert len(logged["world/body/camera/colour"]) == 60
    assert len(logged["world/body"]) == len(logged["curves/base/speed"]) == len(logged["curves/joints/elbow"]) == 300
    assert {"world/body/points", "world/body/links", "world/body/believed"} <= set(logged)
    assert len(logged["world/body/camera/colour/detections"]) == 60
    phases = [what.args[0] for _, what in logged["log"] if what.options["level"] == "INFO"]
    assert phases[0].startswith("fetch red_can: ")
    assert all(0.0 <= time_s < 10.0 for path, each in logged.items() if path != "world" for time_s, _ in each)


def test_rerun_gets_the_messages_of_a_live_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))

    async def look() -> None:
        room = Room()
        bus = room.mesh.join()
        watch(bus, "calliope", waiting)
        bus.publisher("calliope/base/state", Qos.STATE).put(b"no message")
        async with room.node("planning") as planning:
            await room.clock.sleep_until(10**9)
            planning.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.1, turn_radps=0.2), stamp_ns=5)
            await drive(room, 0.2, frames=False)

    waiting = Waiting()
    run_virtual(look())
    waiting.close()
    waiting.log_to(rerun_scene.RerunScene(Stream("cocoro"), ROBOT, Catalogue.load()))
    logged = Stream.newest.logged
    assert len(logged["world/body"]) == 10
    (command,) = logged["curves/base/commanded_speed"]  # however old it is
    assert command[1].args == (0.1,)


def test_without_rerun_one_line_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    for command in (["export", str(GOLDEN), "--rrd", str(tmp_path / "out.rrd")], ["view", str(GOLDEN)], ["view"]):
        assert main(command) == 1
        err = capsys.readouterr().err
        assert "pip install 'cocoro-mesh[view]'" in err
        assert len(err.splitlines()) == 1


def test_what_the_viewer_is_too_slow_for_is_dropped_and_a_frame_first() -> None:
    waiting = Waiting()
    picture = Frame(width=1, height=1, colour=memoryview(b"abc"), depth=memoryview(b"ab"))
    for _ in range(5):
        waiting.put(topics.FRAME.name, picture)
    assert waiting.dropped == 3
    for _ in range(WAITING):
        waiting.put(topics.BASE_COMMAND.name, BaseCommand(ahead_mps=0.0, turn_radps=0.0))
    assert waiting.dropped == 5


DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


@pytest.mark.parametrize("what", [[str(GOLDEN)], [], [str(GOLDEN), "--sim"]])
def test_without_a_display_one_line_says_what_to_do(
    what: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    assert main(["view", *what]) == 2
    err = capsys.readouterr().err
    assert all(option in err for option in ("--web", "--save", "--connect", "DISPLAY"))
    assert len(err.splitlines()) == 1


def test_only_one_place_can_be_chosen(tmp_path: Path) -> None:
    for target in (
        Target(web=True, save=tmp_path / "a.rrd"), Target(web=True, connect="there"), Target(bind="0.0.0.0"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=r"choose one|give --web too"):
            target.check()
    Target(web=True, bind="0.0.0.0").check()


def test_the_address_of_a_viewer_is_a_host_a_port_or_the_whole() -> None:
    assert address_of("laptop") == ("rerun+http://laptop:9876/proxy", "laptop", 9876)
    assert address_of("10.0.0.7:99") == ("rerun+http://10.0.0.7:99/proxy", "10.0.0.7", 99)
    assert address_of("[::1]:99") == ("rerun+http://[::1]:99/proxy", "::1", 99)
    assert address_of("rerun+https://a.b:4/proxy") == ("rerun+https://a.b:4/proxy", "a.b", 4)
    for wrong in ("", "http://laptop", "laptop:port", ":99"):
        with pytest.raises(ConfigError, match="HOST:PORT"):
            address_of(wrong)


def test_nobody_at_an_address_is_told_before_the_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    port = free_port(0, "127.0.0.1")
    assert main(["view", str(GOLDEN), "--connect", f"127.0.0.1:{port}"]) == 1
    err = capsys.readouterr().err
    assert f"no viewer listens at 127.0.0.1 port {port}" in err
    assert len(err.splitlines()) == 1


def test_a_viewer_that_takes_nothing_any_more_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apps.captures.export.viewer.STALLED_S", 0.05)
    never = threading.Event()
    with pytest.raises(CaptureError, match="viewer at there has taken nothing"):
        sent(lambda _: never.wait(), "there")
    never.set()

    def beating(pulse: Pulse) -> int:
        for _ in range(20):
            pulse.beat()
        return 20

    assert sent(beating, "there") == 20


def test_a_file_that_the_disk_did_not_take_whole_is_removed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def flush(_: Stream, timeout_sec: float = 0.0) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    monkeypatch.setattr(Stream, "flush", flush)
    assert main(["view", str(GOLDEN), "--save", str(tmp_path / "a.rrd")]) == 1
    err = capsys.readouterr().err
    assert "could not be written to its end" in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "a.rrd").exists()


def test_an_error_of_rerun_is_told_as_ours() -> None:
    def fails() -> None:
        raise RuntimeError("broken pipe")

    attempt = Attempt(fails)
    assert attempt.join(10.0)
    with pytest.raises(CaptureError, match="broken pipe"):
        attempt.result()


@pytest.mark.process
def test_a_viewer_that_cannot_open_its_window_says_why(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\necho 'Error: winit at x.rs:7: no server at :77' >&2\nexit 1\n")
    program.chmod(0o700)
    monkeypatch.setattr("apps.captures.export.viewer._program", lambda: str(program))
    monkeypatch.setenv("DISPLAY", ":77")
    with ViewerProcess(Target()) as viewer, pytest.raises(CaptureError, match="no server at :77; --web shows it"):
        viewer.wait_until_ready()
    monkeypatch.setattr("apps.captures.export.viewer._program", lambda: str(tmp_path / "none"))
    with pytest.raises(CaptureError, match="does not start"):
        ViewerProcess(Target())


@pytest.mark.process
def test_the_page_is_served_to_this_machine_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "rerun"
    program.write_text('#!/bin/sh\necho "$@" > "$0.arguments"\n')
    program.chmod(0o700)
    monkeypatch.setattr("apps.captures.export.viewer._program", lambda: str(program))
    with ViewerProcess(Target(web=True), tmp_path / "a.rrd") as viewer:
        viewer.wait()
    arguments = (tmp_path / "rerun.arguments").read_text().split()
    assert arguments[:3] == [str(tmp_path / "a.rrd"), "--bind", "127.0.0.1"]
    assert "--serve-web" in arguments
    assert viewer.page.startswith("http://127.0.0.1:")
    assert "url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A" in viewer.page


@pytest.mark.sim
def test_the_simulated_robot_stands_in_the_view_from_outside_where_the_truth_has_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun("rerun"))
    stage = OutsideStage(ROBOT, load_scene("paper", 0))
    with World(ROBOT, stage.scene) as world:
        truth = world.truth()
    rerun_scene.RerunScene(Stream("cocoro"), ROBOT, Catalogue.load(), stage).log("sim/truth", truth)
    logged = Stream.newest.logged
    assert len(Stream.newest.blueprint.args) == 1
    mesh, place = (what for _, what in logged["sim/scene/red_can"])
    assert np.ptp(mesh.options["vertex_positions"][:, 2]) == pytest.approx(0.12)
    assert np.linalg.norm(mesh.options["vertex_normals"], axis=1) == pytest.approx(1.0)
    (can,) = (item for item in truth.objects if item.label == "red_can")
    assert place.options["translation"] == pytest.approx(can.position_m)
    assert {"sim/robot/chassis", "sim/robot/wrist_roll", "sim/robot/wheel_left", "sim/floor"} <= set(logged)


@pytest.mark.process
def test_rerun_itself_takes_it(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun is an extra, and not installed here")
    assert main(["view", str(GOLDEN), "--save", str(tmp_path / "out.rrd")]) == 0
    assert (tmp_path / "out.rrd").stat().st_size > 500_000
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "out.rrd")], check=True)
