"""Files that are moved or removed while they are recorded."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from capture_rig import Room, all_of, drive, entry, writer

from cocoro import topics
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.messages import Recording
from cocoro.vloop import run_virtual
from services.capture.writer import KEPT_DISTURBED, LOOK_S, CaptureWriter, FileLimits, describe_disturbance, locate


class Watch:
    """The writer's clock."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Disturbed:
    """A writer and its file."""

    def __init__(self, folder: Path, limits: FileLimits | None = None) -> None:
        self.watch = Watch()
        self.folder = folder
        self.number = 0
        self.writer: CaptureWriter = writer(folder, limits or FileLimits(), monotonic_s=self.watch)

    def put(self, count: int) -> None:
        for _ in range(count):
            self.writer.put(entry("base/state", self.number))
            self.number += 1

    def flush(self) -> None:
        """One of ten flushes a second, long after the last check."""
        self.watch.now_s += LOOK_S
        self.writer.flush()

    def numbers(self, path: Path) -> list[int]:
        return [record.sequence for record in all_of(path)]


def only(folder: Path) -> Path:
    """The only capture in the folder."""
    (path,) = folder.glob("*.mcap")
    return path


@pytest.fixture
def it(tmp_path: Path) -> Disturbed:
    return Disturbed(tmp_path / "captures")


def test_after_a_removal_it_goes_on_in_the_next_file_and_tells_what_is_lost(it: Disturbed) -> None:
    it.writer.remember("run", {"robot": "calliope"})
    it.put(30)
    it.flush()
    (it.folder / "one-1.mcap").unlink()
    it.put(5)
    it.flush()
    it.put(10)
    it.writer.close()
    assert [path.name for path in it.folder.iterdir()] == ["one-2.mcap"]
    assert it.numbers(it.folder / "one-2.mcap") == list(range(35, 45))
    assert (it.writer.messages, it.writer.removed) == (10, 35)
    assert it.writer.size_bytes == (it.folder / "one-2.mcap").stat().st_size
    assert it.writer.where == str(it.folder / "one-2.mcap")
    (gone,) = it.writer.disturbed
    assert (gone.became, gone.lost) == ("removed", 35)
    assert (
        "one-1.mcap was removed (or moved to another disk) while it was recorded: 35 messages are lost"
        in describe_disturbance(gone)
    )
    with Capture.open(it.folder / "one-2.mcap") as capture:
        assert capture.whole
        assert capture.robot == "calliope"


def test_after_a_move_the_moved_file_is_made_whole_where_it_is_and_nothing_is_lost(it: Disturbed) -> None:
    it.put(30)
    it.flush()
    moved = it.folder / "kept.mcap"
    (it.folder / "one-1.mcap").rename(moved)
    it.put(5)
    it.flush()
    it.put(10)
    it.writer.close()
    assert it.numbers(moved) == list(range(35))
    assert it.numbers(it.folder / "one-2.mcap") == list(range(35, 45))
    assert (it.writer.messages, it.writer.removed) == (45, 0)
    (file,) = it.writer.disturbed
    assert (file.became, file.now, file.lost) == ("moved", str(moved), 0)
    assert describe_disturbance(file) == f"{it.folder / 'one-1.mcap'} was moved to {moved} while it was recorded"
    with Capture.open(moved) as capture:
        assert capture.whole


@pytest.mark.parametrize("became", ["moved", "removed"])
def test_what_happened_since_the_last_look_is_seen_at_the_end(it: Disturbed, became: str) -> None:
    it.put(30)
    it.flush()
    first = it.folder / "one-1.mcap"
    if became == "moved":
        first.rename(it.folder / "kept.mcap")
    else:
        first.unlink()
    it.put(5)
    it.writer.flush()
    it.writer.close()
    assert [file.became for file in it.writer.disturbed] == [became]
    assert it.writer.where == (str(it.folder / "kept.mcap") if became == "moved" else "")
    assert it.writer.messages == (35 if became == "moved" else 0)
    assert it.writer.size_bytes == sum(path.stat().st_size for path in it.folder.iterdir())
    if became == "moved":
        assert it.numbers(it.folder / "kept.mcap") == list(range(35))


def test_a_file_that_is_removed_just_before_the_next_one_begins_is_told_of_too(tmp_path: Path) -> None:
    it = Disturbed(tmp_path, FileLimits(file_bytes=3000))
    it.put(10)
    it.flush()
    (tmp_path / "one-1.mcap").unlink()
    it.put(100)
    it.writer.flush()
    it.put(1)
    it.writer.close()
    assert it.writer.messages + it.writer.removed == 111
    assert it.writer.messages == sum(len(it.numbers(path)) for path in tmp_path.iterdir())
    assert [file.file for file in it.writer.disturbed] == [str(tmp_path / "one-1.mcap")]


def test_another_file_in_its_place_is_left_as_it_is(it: Disturbed) -> None:
    it.put(30)
    it.flush()
    other = it.folder / "other"
    other.write_text("something else")
    other.replace(it.folder / "one-1.mcap")
    it.flush()
    it.put(1)
    it.writer.close()
    assert (it.folder / "one-1.mcap").read_text() == "something else"
    assert [file.became for file in it.writer.disturbed] == ["removed"]
    assert it.numbers(it.folder / "one-2.mcap") == [30]


def test_a_link_in_its_place_that_leads_to_it_disturbs_nothing(it: Disturbed, tmp_path: Path) -> None:
    it.put(30)
    it.flush()
    shutil.move(it.folder / "one-1.mcap", tmp_path / "kept.mcap")
    (it.folder / "one-1.mcap").symlink_to(tmp_path / "kept.mcap")
    it.flush()
    it.writer.close()
    assert it.writer.disturbed == ()
    assert it.numbers(tmp_path / "kept.mcap") == list(range(30))


def test_a_folder_that_is_moved_takes_its_file_along_and_is_made_again_for_the_next(
    it: Disturbed, tmp_path: Path
) -> None:
    it.put(30)
    it.flush()
    it.folder.rename(tmp_path / "archive")
    it.flush()
    it.put(5)
    it.writer.close()
    assert it.numbers(tmp_path / "archive" / "one-1.mcap") == list(range(30))
    assert it.numbers(it.folder / "one-2.mcap") == list(range(30, 35))
    assert [file.now for file in it.writer.disturbed] == [str(tmp_path / "archive" / "one-1.mcap")]


def test_a_folder_that_is_removed_is_made_again(it: Disturbed) -> None:
    it.put(30)
    it.flush()
    shutil.rmtree(it.folder)
    it.flush()
    it.put(5)
    it.writer.close()
    assert it.numbers(it.folder / "one-2.mcap") == list(range(30, 35))
    assert it.writer.removed == 30


def test_a_move_whose_end_the_system_does_not_tell_loses_nothing(
    it: Disturbed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    readlink = Path.readlink

    def no_proc(path: Path) -> Path:
        if str(path).startswith("/proc"):
            raise FileNotFoundError
        return readlink(path)

    monkeypatch.setattr(Path, "readlink", no_proc)
    it.put(30)
    (it.folder / "one-1.mcap").rename(tmp_path / "kept.mcap")
    it.flush()
    it.writer.close()
    (file,) = it.writer.disturbed
    assert (file.became, file.now, it.writer.messages) == ("moved", "", 30)
    assert "was moved elsewhere" in describe_disturbance(file)


def test_a_second_name_that_is_left_is_no_loss(it: Disturbed, tmp_path: Path) -> None:
    it.put(30)
    os.link(it.folder / "one-1.mcap", tmp_path / "second.mcap")
    (it.folder / "one-1.mcap").unlink()
    it.flush()
    it.writer.close()
    assert ([file.became for file in it.writer.disturbed], it.writer.removed) == (["moved"], 0)
    assert it.numbers(tmp_path / "second.mcap") == list(range(30))


def test_what_a_network_file_system_keeps_of_a_removed_file_is_a_removed_file(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with path.open("wb") as file:
        path.rename(tmp_path / ".nfs0000000012")
        assert locate(path, file.fileno()) == ("removed", "")


def test_a_folder_that_cannot_be_looked_into_says_nothing_of_the_file(
    it: Disturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(_: Path) -> Any:
        raise PermissionError

    it.put(30)
    monkeypatch.setattr(Path, "stat", denied)
    assert locate(it.writer.file.path, it.writer.file.fileno()).state == "there"


def test_it_is_looked_once_a_second(it: Disturbed, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = []

    def look(path: Path, fd: int) -> Any:
        looks.append(it.watch.now_s)
        return locate(path, fd)

    monkeypatch.setattr("services.capture.writer.locate", look)
    for _ in range(100):
        it.watch.now_s += 0.1
        it.writer.flush()
    assert 9 <= len(looks) <= 11
    it.writer.close()


def test_one_who_removes_every_file_is_told_of_in_bounded_words(it: Disturbed) -> None:
    for number in range(1, 3 * KEPT_DISTURBED):
        it.put(2)
        (it.folder / f"one-{number}.mcap").unlink()
        it.flush()
    it.writer.close()
    assert len(it.writer.disturbed) == KEPT_DISTURBED
    assert it.writer.removed == 2 * (3 * KEPT_DISTURBED - 1)


def test_when_there_is_no_place_for_the_next_file_recording_stops_and_says_so(it: Disturbed) -> None:
    it.put(30)
    it.flush()
    shutil.rmtree(it.folder)
    it.folder.write_text("no folder")
    with pytest.raises(CaptureError, match=r"(Not a directory|File exists)$"):
        it.flush()
    assert it.writer.removed == 30


def test_the_mesh_hears_of_a_removal_and_of_a_move(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.capture.writer.LOOK_S", 0.0)
    said: list[Recording] = []
    health: list[Any] = []

    async def scenario(room: Room) -> None:
        async with room.node("operator") as operator:
            operator.on(topics.RECORDING.of("capture"), said.append)
            operator.on(topics.HEALTH.of("capture"), health.append)
            await drive(room, 1.0)
            first = only(tmp_path)
            first.rename(tmp_path / "kept")
            await drive(room, 2.0)
            assert (health[-1].state, [str(tmp_path / "kept") in fault for fault in health[-1].faults]) == (
                "ready", [True],
            )  # fmt: skip
            second = only(tmp_path)
            second.unlink()
            await drive(room, 2.0)

    run_virtual(Room().recorded({"folder": str(tmp_path), "per_occasion": False}, scenario))
    assert (health[-1].state, health[-1].text) == ("degraded", "messages are lost")
    assert "messages are lost" in health[-1].faults[-1]
    last = said[-1]
    assert last.fault == ""
    assert [file.became for file in last.disturbed] == ["moved", "removed"]
    third = only(tmp_path)
    assert last.file == str(third)
    assert third.name.endswith("-003.mcap")
    assert last.removed == last.disturbed[1].lost > 100


def test_the_last_word_counts_what_is_on_the_disk(tmp_path: Path) -> None:
    said: list[Recording] = []

    async def scenario(room: Room) -> None:
        async with room.node("operator") as operator:
            operator.on(topics.RECORDING.of("capture"), said.append)
            operator.on(topics.HEALTH.of("capture"), lambda _: None)
            await drive(room, 1.0)
            (tmp_path / "one.mcap").unlink()
            await drive(room, 0.3)

    async def heard(room: Room) -> None:
        async with room.node("listener") as listener:
            listener.on(topics.RECORDING.of("capture"), said.append)
            await room.recorded({"file": str(tmp_path / "one.mcap")}, scenario)

    run_virtual(heard(Room()))
    last = said[-1]
    assert last.ended
    assert (last.file, last.messages, last.size_bytes) == ("", 0, 0)
    assert last.removed > 50
