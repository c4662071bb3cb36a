"""Captures that are cut, flipped or emptied, and files that are no captures: a clear error, or a partial reading that
reports what is missing."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_rig import all_of, drive, record

from apps.captures.info import report
from apps.captures.rewrite import rewrite
from apps.cli.main import main
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture, Record
from services.capture.packing import Packer

pytestmark = pytest.mark.sweep

DAMAGES = 1000

Told = tuple[str, int, int, int, bytes]
Damage = Callable[[random.Random, bytearray], None]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damage")


@pytest.fixture(scope="module")
def whole(folder: Path) -> bytes:
    """A closed capture of two seconds."""
    return record(folder / "whole.mcap", drive, rotate_mb=1.0).read_bytes()


@pytest.fixture(scope="module")
def killed(whole: bytes) -> bytes:
    """The capture as a killed recorder leaves it: without its end."""
    return whole[: int(len(whole) * 0.9)]


@pytest.fixture(scope="module")
def original(whole: bytes, folder: Path) -> set[Told]:
    return {_told(each) for each in all_of(folder / "whole.mcap")}


def cut(draw: random.Random, data: bytearray) -> None:
    del data[draw.randrange(len(data)) :]


def flip(draw: random.Random, data: bytearray) -> None:
    for _ in range(draw.choice((1, 1, 2, 8))):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)


def blank(draw: random.Random, data: bytearray) -> None:
    start, length = draw.randrange(len(data)), draw.choice((1, 16, 512, 4096))
    data[start : start + length] = bytes(len(data[start : start + length]))


def lose(draw: random.Random, data: bytearray) -> None:
    start = draw.randrange(len(data))
    del data[start : start + draw.choice((1, 7, 512, 5000))]


def insert(draw: random.Random, data: bytearray) -> None:
    start = draw.randrange(len(data))
    data[start:start] = draw.randbytes(draw.choice((1, 9, 600)))


def swap(draw: random.Random, data: bytearray) -> None:
    one, other = sorted(draw.sample(range(len(data)), 2))
    length = min(512, other - one)
    data[one : one + length], data[other : other + length] = data[other : other + length], data[one : one + length]


@pytest.mark.parametrize("damage", [cut, flip, blank, lose, insert, swap], ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("state", ["whole", "killed"])
def test_a_damaged_capture_gives_nothing_but_what_was_recorded_and_says_what_is_missing(
    damage: Damage, state: str, original: set[Told], folder: Path, request: pytest.FixtureRequest
) -> None:
    data: bytes = request.getfixturevalue(state)
    path = folder / f"{state}-{damage.__name__}.mcap"
    with Capture.open(folder / "whole.mcap") as capture:
        metadata = capture.metadata
    draw = random.Random(f"{state} {damage.__name__}")
    for _ in range(DAMAGES // 12 + 1):
        damaged = bytearray(data)
        damage(draw, damaged)
        path.write_bytes(damaged)
        reading = _read(path)
        if isinstance(reading, str):
            assert str(path) in reading
            continue
        found, told, closed, problems, counted = reading
        assert all(entries in metadata.values() for entries in told.values())
        assert not closed or told.items() <= metadata.items()
        assert told.keys() >= metadata.keys() or problems or not closed
        assert set(found) <= original
        assert len(found) == len(set(found))
        if state == "whole" and len(found) < len(original):
            assert problems or not closed
        assert counted == len(found) or problems


def _read(path: Path) -> str | tuple[list[Told], dict[str, dict[str, str]], bool, list[str], int]:
    """The result of reading: the error's text; or the messages, the metadata, whether it was closed, the problems, and
    the number of messages in the report."""
    try:
        with Capture.open(path) as capture:
            found = [_told(each) for each in capture.messages()]
            counted = report(capture).messages
            return found, capture.metadata, capture.closed, capture.problems, counted
    except CaptureError as error:
        return str(error)


def _told(each: Record) -> Told:
    return each.key, each.sequence, each.log_ns, each.publish_ns, bytes(each.payload)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"x" * 1000, "no MCAP file"),
        (b"\x89MCAP0\r", "no MCAP file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(500), "no MCAP file"),
    ],
    ids=["empty", "foreign", "short", "picture"],
)
def test_what_is_no_capture_is_told_in_one_line(
    data: bytes, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "foreign.mcap"
    path.write_bytes(data)
    for command in (
        ["capture", "info"],
        ["capture", "repair"],
        ["capture", "reexecute", "--service", "perception"],
        ["replay"],
    ):
        assert main([*command, str(path)]) == 1
        captured = capsys.readouterr()
        assert words in captured.err
        assert len(captured.err.splitlines()) == 1


def test_a_capture_that_is_missing_or_a_folder_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (tmp_path / "none.mcap", tmp_path):
        assert main(["capture", "info", str(path)]) == 1
        assert str(path) in capsys.readouterr().err


def test_a_record_that_its_recorder_did_not_finish_is_no_damage_but_told_of(
    whole: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "killed.mcap"
    path.write_bytes(whole)
    with Capture.open(path) as capture:
        last = capture.places[-1]
    path.write_bytes(whole[: last.offset + last.length - 10])
    with Capture.open(path) as capture:
        assert capture.problems == []
        assert capture.cut_bytes == last.length - 10
    assert main(["capture", "info", str(path)]) == 0
    assert f"the last record is cut off after {last.length - 10} bytes" in capsys.readouterr().out
    for command in (["export", str(path), "--csv", str(tmp_path / "csv")], ["capture", "repair", str(path)]):
        assert main(command) == 0
        out, err = capsys.readouterr()
        assert "killed.mcap was not closed" in out + err
    assert main(["capture", "info", str(tmp_path / "killed.repaired.mcap")]) == 0
    assert "made of   killed.mcap, which was not closed" in capsys.readouterr().out


def test_a_damaged_capture_is_mended_as_far_as_it_goes(
    whole: bytes, tmp_path: Path, original: set[Told], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(whole)
    with Capture.open(path) as capture:
        longest = max(capture.places, key=lambda place: place.length)
    damaged = bytearray(whole)
    middle = longest.offset + longest.length // 2
    damaged[middle : middle + 100] = os.urandom(100)
    path.write_bytes(damaged)
    assert main(["capture", "info", "--check", str(path)]) == 1
    assert "damaged:" in capsys.readouterr().out
    assert main(["capture", "repair", str(path)]) == 0
    assert "missing:" in capsys.readouterr().out
    mended = tmp_path / "damaged.repaired.mcap"
    assert main(["capture", "info", "--check", str(mended)]) == 0
    assert "made of   damaged.mcap, which was damaged; " in capsys.readouterr().out
    found = {_told(each) for each in all_of(mended)}
    assert found < original
    assert len(found) > len(original) / 2
    with Capture.open(path) as capture, pytest.raises(CaptureError, match="exists; remove it"):
        rewrite(capture, mended, Packer("zstd"))


def test_a_whole_capture_is_not_repaired(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "whole.mcap"
    path.write_bytes((Path(__file__).parent / "golden" / "fetch.mcap").read_bytes())
    assert main(["capture", "repair", str(path)]) == 0
    assert "it is whole, so there is nothing to repair" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [path]
