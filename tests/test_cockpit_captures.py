"""The cockpit's captures: listed, played by the scene of the live page, kept, deleted by a rule, and the log."""

from __future__ import annotations

import json
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cockpit_rig import CockpitRig, cockpit

from cocoro.capture.folder import pin_of
from cocoro.errors import RefusedError
from cocoro.messages import Recording
from cocoro.testing import in_virtual_time
from cocoro.topics import RECORDING
from services.cockpit.log_lines import FIRST_LINES, LogLines
from services.cockpit.playing import Playback
from services.cockpit.scene import Scene
from services.cockpit.shelf import NoCaptureError, Rule, Shelf

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
NAME = "calliope-20260101T120000Z-001-fetch-red_can"


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    """A folder with one capture of a fetch."""
    shutil.copy(GOLDEN, tmp_path / f"{NAME}.mcap")
    return tmp_path


def made(folder: Path, name: str, days_old: float = 0.0) -> Path:
    path = folder / f"{name}.mcap"
    path.write_bytes(b"no MCAP file")
    then = datetime.now(UTC).timestamp() - days_old * 86_400
    os.utime(path, (then, then))
    return path


def names(folder: Path) -> set[str]:
    return {path.name.removesuffix(".mcap") for path in folder.glob("*.mcap")}


def written_now(rig: CockpitRig, path: Path) -> None:
    """Has a recorder tell that it writes this file."""
    rig.service.feed(RECORDING.of("capture"), Recording(file=str(path)))


# --- the shelf ------------------------------------------------------------------------------------


@in_virtual_time
async def test_captures_are_listed_the_newest_first_with_what_happened_in_them(shelf: Path) -> None:
    made(shelf, "calliope-20260102T120000Z-001-idle")
    made(shelf, "notes")  # which no recorder named
    async with cockpit(shelf) as rig:
        answer = await rig.request("GET", "/captures")
        idle, fetch = answer.json["captures"]
        assert (idle["name"], fetch["name"]) == ("calliope-20260102T120000Z-001-idle", NAME)
        assert (idle["what"], idle["closed"]) == ("", False)
        assert fetch["what"] == "fetch-red_can"
        assert fetch["size_bytes"] == GOLDEN.stat().st_size


@in_virtual_time
async def test_a_capture_is_pinned_and_then_not_deleted(shelf: Path) -> None:
    async with cockpit(shelf) as rig:
        assert (await rig.request("POST", f"/captures/{NAME}/pin")).json == {"ok": True}
        assert (await rig.request("GET", "/captures")).json["captures"][0]["pinned"]
        refused = await rig.request("DELETE", f"/captures/{NAME}")
        assert (refused.status, b"pinned" in refused.body) == (409, True)
        await rig.request("POST", f"/captures/{NAME}/unpin")
        assert (await rig.request("DELETE", f"/captures/{NAME}")).status == 200
        assert names(shelf) == set()


@in_virtual_time
async def test_the_capture_that_is_being_written_stays(shelf: Path) -> None:
    async with cockpit(shelf) as rig:
        written_now(rig, shelf / f"{NAME}.mcap")
        refused = await rig.request("DELETE", f"/captures/{NAME}")
        assert (refused.status, b"being written" in refused.body) == (409, True)
        assert (await rig.request("GET", "/captures")).json["captures"][0]["written"]
        cleaned = await rig.request("POST", "/captures/clean", b'{"older_than_days": 0}')
        assert cleaned.json["deleted"] == []


@in_virtual_time
async def test_the_recorders_own_folder_is_listed_too(shelf: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    async with cockpit(elsewhere) as rig:
        written_now(rig, shelf / f"{NAME}.mcap")
        assert [one["name"] for one in (await rig.request("GET", "/captures")).json["captures"]] == [NAME]


@in_virtual_time
async def test_a_viewer_looks_at_captures_and_changes_none(shelf: Path) -> None:
    async with cockpit(shelf, "viewer") as rig:
        assert (await rig.request("GET", "/captures")).status == 200
        for method, path in (
            ("DELETE", f"/captures/{NAME}"), ("POST", f"/captures/{NAME}/pin"), ("POST", "/captures/clean"),
        ):  # fmt: skip
            assert (await rig.request(method, path, b'{"idle": true}')).status == 403
        assert names(shelf) == {NAME}


@pytest.mark.parametrize("name", ["nix", "..", "../secret", "%2e%2e%2fsecret", f"{NAME}.mcap", "*", "/etc/passwd"])
def test_only_what_a_recorder_named_is_given_out_or_deleted(name: str, shelf: Path) -> None:
    made(shelf.parent, "secret")

    @in_virtual_time
    async def tried() -> None:
        async with cockpit(shelf) as rig:
            for method, path in (("GET", f"/captures/{name}/file"), ("DELETE", f"/captures/{name}")):
                assert (await rig.request(method, path)).status in (404, 405)
        assert (shelf.parent / "secret.mcap").exists()

    tried()


@pytest.mark.parametrize("body", [b"", b"{}", b'{"idle": false}', b'{"older_than_days": -1}', b'{"all": true}'])
def test_a_rule_that_says_nothing_deletes_nothing(body: bytes, shelf: Path) -> None:
    @in_virtual_time
    async def tried() -> None:
        async with cockpit(shelf) as rig:
            assert (await rig.request("POST", "/captures/clean", body)).status == 400
            assert names(shelf) == {NAME}

    tried()


def test_a_rule_deletes_what_fulfils_all_of_it_and_is_not_pinned(tmp_path: Path) -> None:
    old_idle, old_task, new_idle, pinned = (
        made(tmp_path, f"calliope-20260101T120000Z-00{number}-{label}", days)
        for number, (label, days) in enumerate([("idle", 9), ("fetch", 9), ("idle", 1), ("idle", 9)], start=1)
    )
    pin_of(pinned).touch()
    shelf = Shelf(tmp_path)
    assert shelf.clean(Rule(idle=True, older_than_days=5), []) == [old_idle.stem]
    assert shelf.clean(Rule(older_than_days=5), []) == [old_task.stem]
    assert shelf.clean(Rule(idle=True), []) == [new_idle.stem]
    assert names(tmp_path) == {pinned.stem}


def test_a_folder_that_is_not_there_holds_no_captures(tmp_path: Path) -> None:
    shelf = Shelf(tmp_path / "nowhere")
    assert shelf.listed([]) == []
    with pytest.raises(NoCaptureError, match="no capture 'x'"):
        shelf.find("x")
    with pytest.raises(NoCaptureError):
        shelf.remove("x", [])


def test_a_pin_that_cannot_be_written_is_refused_with_the_reason(shelf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "touch", full)
    with pytest.raises(RefusedError, match="No space left"):
        Shelf(shelf).pin(NAME, True)


# --- playing --------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_capture_is_played_as_if_it_were_live(shelf: Path) -> None:
    async with cockpit(shelf) as rig, rig.page(f"/play?capture={NAME}") as page:
        await rig.service.advance(3.0)
        (hello,) = page.of("hello")
        assert (hello["live"], hello["capture"], hello["robot"]) == (False, NAME, "calliope")
        played = page.of("played")[-1]
        assert played["at_s"] == pytest.approx(3.0, abs=0.2)
        assert played["duration_s"] > 3.0
        assert {mark["kind"] for mark in played["marks"]} >= {"task", "phase"}
        assert page.state["task"]["task"] == "fetch"
        assert page.state["plan"]["body"] is not None


@in_virtual_time
async def test_playing_is_paused_sped_up_and_goes_where_it_is_told(shelf: Path) -> None:
    async with cockpit(shelf) as rig, rig.page(f"/play?capture={NAME}") as page:
        page.say("pause", on=True)
        await rig.service.advance(0.5)
        held_s = page.of("played")[-1]["at_s"]
        await rig.service.advance(2.0)
        assert (page.of("played")[-1]["at_s"], page.of("played")[-1]["paused"]) == (held_s, True)
        page.say("seek", at_s=4.0)
        await rig.service.advance(0.3)
        assert page.of("played")[-1]["at_s"] == 4.0
        there = page.state["task"]["phase"]
        assert there != "idle"
        page.say("seek", at_s=1.0)
        await rig.service.advance(0.3)
        assert page.of("played")[-1]["at_s"] == 1.0
        page.say("speed", x=4.0)
        page.say("pause", on=False)
        await rig.service.advance(1.0)
        assert page.of("played")[-1]["at_s"] == pytest.approx(5.0, abs=0.4)


@in_virtual_time
async def test_at_its_end_a_capture_stands_and_plays_again_from_the_beginning(shelf: Path) -> None:
    async with cockpit(shelf) as rig, rig.page(f"/play?capture={NAME}") as page:
        page.say("speed", x=16.0)
        await rig.service.advance(5.0)
        last = page.of("played")[-1]
        assert (last["ended"], last["at_s"]) == (True, pytest.approx(last["duration_s"], abs=0.01))
        page.say("speed", x=1.0)
        page.say("pause", on=False)
        await rig.service.advance(1.0)
        assert page.of("played")[-1]["at_s"] == pytest.approx(1.0, abs=0.2)


def test_what_is_seen_after_a_jump_is_what_is_seen_when_it_is_played_to_there(shelf: Path) -> None:
    def at(playback: Playback) -> dict[str, object]:
        state = Scene.state(playback.scene, playback.now_ns)
        return {name: state[name] for name in ("task", "plan", "base")}

    played, jumped = Playback(shelf / f"{NAME}.mcap"), Playback(shelf / f"{NAME}.mcap")
    played.step(100.0)
    played.step(103.0)
    jumped.seek(50.0, 3.0)
    jumped.pause(50.0, True)
    jumped.step(50.0)
    assert at(jumped) == at(played)
    played.close()
    jumped.close()


@in_virtual_time
async def test_the_robot_is_stopped_from_a_page_that_plays_a_capture_too(shelf: Path) -> None:
    async with cockpit(shelf) as rig, rig.page(f"/play?capture={NAME}") as page:
        reply = await page.asks("stop")
        assert "nothing has acknowledged" in reply["text"]
        page.say("run", id=1, task={"task": "park"})
        await rig.service.advance(0.2)
        assert page.closed is not None
        assert page.closed[0] == 1008


@in_virtual_time
async def test_a_capture_that_is_not_there_or_not_readable_is_said(shelf: Path) -> None:
    made(shelf, "calliope-20260102T120000Z-001-fetch")
    async with cockpit(shelf) as rig:
        for name, why in (("nix", "no capture 'nix'"), ("calliope-20260102T120000Z-001-fetch", "MCAP")):
            async with rig.page(f"/play?capture={name}") as page:
                await rig.service.advance(0.5)
                assert page.closed is not None
                assert page.closed[0] == 4404
                assert why in page.closed[1]


# --- the log --------------------------------------------------------------------------------------


def line(second: int, text: str, level: str = "INFO", process: str = "planning") -> str:
    return f"2026-01-01T12:00:{second:02}.000 {level:<7} {process}: {text}\n"


def private_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir(mode=0o700)
    return folder


def test_the_lines_of_all_processes_come_in_the_order_of_their_times(tmp_path: Path) -> None:
    folder = private_folder(tmp_path)
    (folder / "planning.log").write_text(line(1, "a") + line(3, "c"))
    (folder / "base.log").write_text(line(2, "b", "WARNING", "base"))
    lines = LogLines(folder)
    assert [(one["text"], one["level"], one["service"]) for one in lines.take()] == [
        ("a", "info", "planning"), ("b", "warning", "base"), ("c", "info", "planning"),
    ]  # fmt: skip
    assert lines.take() == []


def test_new_lines_come_once_also_those_of_a_process_that_started_anew(tmp_path: Path) -> None:
    folder = private_folder(tmp_path)
    log = folder / "planning.log"
    log.write_text(line(1, "a"))
    lines = LogLines(folder)
    lines.take()
    with log.open("a") as file:
        file.write(line(2, "b") + line(3, "half")[:-3])
    assert [one["text"] for one in lines.take()] == ["b"]
    with log.open("a") as file:
        file.write("lf\n")
    assert [one["text"] for one in lines.take()] == ["half"]
    log.rename(folder / "planning.log.1")
    log.write_text(line(4, "new"))
    assert [one["text"] for one in lines.take()] == ["new"]


def test_of_a_long_log_the_end_is_told_and_a_traceback_stays_with_its_line(tmp_path: Path) -> None:
    folder = private_folder(tmp_path)
    (folder / "planning.log").write_text(
        "".join(line(1, f"line {n}") for n in range(3000)) + line(2, "crashed", "ERROR") + "Traceback\n  more\n"
    )
    found = LogLines(folder).take()
    assert len(found) == FIRST_LINES
    assert [(one["text"], one["level"]) for one in found[-3:]] == [
        ("crashed", "error"), ("Traceback", "error"), ("  more", "error"),
    ]  # fmt: skip


def test_without_logs_there_are_no_lines(tmp_path: Path) -> None:
    assert LogLines(tmp_path / "nowhere").take() == []


def test_a_page_that_wants_the_log_gets_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COCORO_LOG_DIR", str(tmp_path))
    (tmp_path / "calliope").mkdir(mode=0o755)
    (tmp_path / "calliope" / "base.log").write_text(line(1, "ready", process="base"))

    @in_virtual_time
    async def tried() -> None:
        async with cockpit(tmp_path) as rig, rig.page() as page, rig.page() as other:
            await rig.service.advance(1.0)
            assert page.of("log") == []
            page.say("log", on=True)
            await rig.service.advance(1.0)
            assert [one["text"] for one in page.of("log")[0]["lines"]] == ["ready"]
            other.say("log", on=True)  # later, and gets what was told before
            await rig.service.advance(1.0)
            assert [one["text"] for one in other.of("log")[0]["lines"]] == ["ready"]

    tried()


def test_every_line_is_json(tmp_path: Path) -> None:
    folder = private_folder(tmp_path)
    (folder / "base.log").write_bytes(b"\xff\xfe no text\n" + line(1, 'a "quoted" \\ line').encode())
    assert json.dumps(LogLines(folder).take())
