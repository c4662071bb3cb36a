"""The emergency stop's latch on disk."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from apps.cli import doctor
from cocoro.stop import asking, record
from cocoro.stop.record import RECORD_BYTES, LatchRecord, latch_dir, prepare, read

PATIENCE_S = 60.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "robbie" / "latch"


def test_a_machine_that_never_knew_a_latch_is_released_by_a_person_only(folder: Path, tmp_path: Path) -> None:
    said = prepare(folder, ["base", "arm"], by_hand=True)
    assert [one.latched for one in said.values()] == [False, False]
    unwatched = prepare(tmp_path / "other", ["base", "arm"], by_hand=False)
    assert [one.latched for one in unwatched.values()] == [True, True]
    assert unwatched["base"].by == "a first start without a person"


def test_a_record_that_is_missing_beside_others_is_latched(folder: Path) -> None:
    prepare(folder, ["base", "arm"], by_hand=True)
    (folder / "base").unlink()
    said = prepare(folder, ["base", "arm"], by_hand=True)
    assert said["base"].latched
    assert said["base"].by == "its record was missing"
    assert not said["arm"].latched


def test_what_is_kept_is_what_the_next_process_reads(folder: Path) -> None:
    prepare(folder, ["base"], by_hand=True)
    before = LatchRecord(folder / "base")
    assert not before.entry.latched
    assert before.keep(True, "operator (user 7, pid 8)").result(PATIENCE_S) == ""
    after = LatchRecord(folder / "base")
    assert (after.entry.latched, after.entry.by) == (True, "operator (user 7, pid 8)")
    assert after.entry.when
    assert prepare(folder, ["base"], by_hand=True)["base"].latched, "a start releases nothing"
    assert after.keep(False, "operator").result(PATIENCE_S) == ""
    assert not read(folder / "base").latched


@pytest.mark.parametrize("by", ["", "x" * 5000, "Jörg \N{ROBOT FACE}" * 50, '"\\' * 500, "a\nb\0c\x1b", "\udcff"])
def test_a_record_never_grows_whoever_wrote_it(folder: Path, by: str) -> None:
    prepare(folder, ["base"], by_hand=True)
    assert LatchRecord(folder / "base").keep(True, by).result(PATIENCE_S) == ""
    assert (folder / "base").stat().st_size == RECORD_BYTES
    assert read(folder / "base").latched
    assert "cannot be read" not in read(folder / "base").by


@pytest.mark.parametrize("byte", range(0, RECORD_BYTES, 7))
def test_a_record_of_which_one_byte_is_damaged_is_latched(folder: Path, byte: int) -> None:
    prepare(folder, ["base"], by_hand=True)
    data = bytearray((folder / "base").read_bytes())
    data[byte] ^= 0x10
    (folder / "base").write_bytes(data)
    assert read(folder / "base").latched


@pytest.mark.parametrize("content", [b"", b"\0" * RECORD_BYTES, b"{}", b"x" * 100_000])
def test_rubbish_is_latched_says_why_and_is_put_right_by_the_next_word(folder: Path, content: bytes) -> None:
    prepare(folder, ["base"], by_hand=True)
    (folder / "base").write_bytes(content)
    kept = LatchRecord(folder / "base")
    assert kept.entry.latched
    assert f"{folder}/base" in kept.entry.by
    assert "damaged" in kept.entry.by
    assert kept.keep(False, "operator").result(PATIENCE_S) == ""
    assert not read(folder / "base").latched


def test_a_missing_record_is_latched_and_made_by_the_next_word(folder: Path) -> None:
    folder.mkdir(parents=True)
    kept = LatchRecord(folder / "base")
    assert kept.entry.latched
    assert "No such file" in kept.entry.by
    assert kept.keep(False, "operator").result(PATIENCE_S) == ""
    assert not read(folder / "base").latched


def test_a_record_that_was_removed_meanwhile_is_made_anew(folder: Path) -> None:
    prepare(folder, ["base"], by_hand=True)
    kept = LatchRecord(folder / "base")
    (folder / "base").unlink()
    assert kept.keep(True, "operator").result(PATIENCE_S) == ""
    assert read(folder / "base").latched


def test_where_it_cannot_be_written_it_says_so_and_tries_again_at_the_next_word(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(folder, ["base"], by_hand=True)
    kept = LatchRecord(folder / "base")

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        assert kept.keep(True, "operator").result(PATIENCE_S) == f"{folder}/base: No space left on device"
        assert "No space" in kept.keep(True, "operator").result(PATIENCE_S)
    assert kept.keep(True, "operator").result(PATIENCE_S) == ""
    assert read(folder / "base").latched


def test_what_could_not_be_read_is_not_said_to_be_on_the_disk_unless_it_is_written_anew(folder: Path) -> None:
    folder.parent.mkdir(parents=True)
    folder.touch()  # a file where a folder should be
    kept = LatchRecord(folder / "base")
    assert kept.entry.latched
    assert kept.keep(True, "operator").result(PATIENCE_S)
    folder.unlink()
    folder.mkdir()
    assert kept.keep(True, "operator").result(PATIENCE_S) == ""
    assert read(folder / "base") == kept.entry._replace(when=read(folder / "base").when)


def test_a_write_that_fails_in_a_way_of_which_nobody_thought_is_not_the_last(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(folder, ["base"], by_hand=True)
    kept = LatchRecord(folder / "base")

    def fail(*_: object) -> int:
        raise ValueError("out of order")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", fail)
        assert kept.keep(True, "operator").result(PATIENCE_S) == f"{folder}/base: out of order"
    assert kept.keep(True, "operator").result(PATIENCE_S) == ""


def test_a_flood_of_stops_is_written_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare(folder, ["base"], by_hand=True)
    kept = LatchRecord(folder / "base")
    go_on = threading.Event()
    written: list[bytes] = []

    def slow(fd: int, data: bytes, at: int) -> int:
        go_on.wait(PATIENCE_S)
        written.append(data)
        return len(data)

    monkeypatch.setattr(os, "pwrite", slow)
    waiting = [kept.keep(True, "operator") for _ in range(1000)]
    assert not waiting[0].done(), "nobody waits for a slow disk"
    go_on.set()
    assert {one.result(PATIENCE_S) for one in waiting} == {""}
    assert len(written) == 1


def test_links_are_not_followed(folder: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    prepare(folder, ["arm"], by_hand=True)
    (folder / "base").symlink_to(victim)
    said = prepare(folder, ["base", "arm"], by_hand=True)
    assert said["base"].latched
    kept = LatchRecord(folder / "base")
    kept.keep(True, "operator").result(PATIENCE_S)
    assert victim.read_bytes() == b"precious"


def test_a_folder_that_others_can_write_to_is_refused(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    with pytest.raises(PermissionError):
        prepare(folder, ["base"], by_hand=True)


def test_the_place_outlives_a_reboot_and_is_the_same_for_the_unit_file_and_by_hand(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in (record.STATE_DIR, "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(record, "MACHINES", tmp_path / "lib")
    monkeypatch.setenv("HOME", "/home/robbie")
    assert latch_dir("calliope") == Path("/home/robbie/.local/state/cocoro/calliope/latch")
    monkeypatch.setenv("XDG_STATE_HOME", "/home/robbie/state")
    assert latch_dir("calliope") == Path("/home/robbie/state/cocoro/calliope/latch")
    monkeypatch.setattr(record, "MACHINES", Path("/proc/1"))
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    assert latch_dir("calliope") == Path("/home/robbie/state/cocoro/calliope/latch"), "it is another's"
    monkeypatch.undo()
    monkeypatch.delenv(record.STATE_DIR, raising=False)
    (tmp_path / "lib").mkdir()
    monkeypatch.setattr(record, "MACHINES", tmp_path / "lib")
    assert latch_dir("calliope") == tmp_path / "lib" / "calliope" / "latch"
    monkeypatch.setenv(record.STATE_DIR, "/somewhere")
    assert latch_dir("calliope") == Path("/somewhere/calliope/latch")


# --- what the doctor says of it ---------------------------------------------------------------------


def test_the_doctor_says_where_the_latch_is_kept_and_that_it_is_latched() -> None:
    path, latch = doctor.stop_checks("robbie")
    assert (path.state, latch.state) == ("ok", "ok")
    assert str(latch_dir("robbie")) in latch.text
    prepare(latch_dir("robbie"), ["base"], by_hand=False)
    _, latch = doctor.stop_checks("robbie")
    assert (latch.state, "`cocoro reset`" in latch.text) == ("note", True)


def test_the_doctor_warns_of_a_place_that_does_not_outlive_a_reboot_or_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert doctor._filesystem(Path("/proc")) != "tmpfs"
    monkeypatch.setattr(doctor, "_filesystem", lambda _: "tmpfs")
    assert [one.state for one in doctor.stop_checks("robbie")] == ["ok", "bad"]
    (tmp_path / "file").touch()
    monkeypatch.setenv(record.STATE_DIR, str(tmp_path / "file"))
    assert "the robot starts stopped" in list(doctor.stop_checks("robbie"))[1].text


def test_the_doctor_says_when_the_kernels_list_cannot_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asking, "SOCKETS", "/nowhere/unix")
    path, _ = doctor.stop_checks("robbie")
    assert (path.state, "is /proc mounted?" in path.text) == ("bad", True)
