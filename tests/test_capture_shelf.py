"""Names in place of a capture's file, the list of captures, and pins."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from apps.captures import shelf
from apps.captures.names import open_captures
from apps.cli import completions, exits
from apps.cli.main import main
from apps.cli.status import space
from cocoro.capture.folder import is_pinned
from cocoro.capture.occasion import OCCASION, Occasion
from cocoro.clock import NS
from cocoro.messages import Recording
from deploy.rundir import RunDir
from services.capture.file import CaptureFile
from services.capture.packing import Packer
from services.capture.writer import sync_and_close

RUN = "calliope-20260101T000000Z"


def make(folder: Path, number: int, what: str = "", outcome: str = "", close: bool = True) -> Path:
    label = what.replace(" ", "-") or "idle"
    path = folder / f"{RUN}-{number:03}-{label}.mcap"
    file = CaptureFile(path, Packer("zstd"))
    if what:
        kind = "task" if outcome else what
        began = Occasion(kind=kind, what=what, label=label, began_ns=number * NS, task_id=f"{what[:5]}-{number}")
        for words in ("", outcome):
            began.outcome = words
            file.metadata(OCCASION, began.entries())
    if close:
        file.tally({}, {})
        sync_and_close(file.finish())
    else:
        file.abandon()
    os.utime(path, (number, number))
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Six captures: nothing, a fetch, nothing, a stop, another fetch that failed, and nothing, not closed."""
    monkeypatch.setenv("COCORO_CAPTURE_DIR", str(tmp_path / "captures"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "captures").mkdir()
    for number, (what, outcome) in enumerate(
        [("", ""), ("fetch red_can", "done"), ("", ""), ("stop", ""), ("fetch blue_can", "failed"), ("", "")], 1
    ):
        make(tmp_path / "captures", number, what, outcome, close=number < 6)
    return tmp_path / "captures"


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("latest", 5), ("latest-1", 4), ("latest-2", 2), ("idle", 6), ("idle-2", 1), ("fetch", 5), ("fetch-1", 2),
        ("fetch red_can", 2), ("fetch-red_can", 2), ("stop", 4), ("fetch-2", 2), (f"{RUN}-003-idle.mcap", 3),
    ],
)  # fmt: skip
def test_a_name_stands_for_a_file(folder: Path, name: str, number: int) -> None:
    assert shelf.find(name).name.startswith(f"{RUN}-{number:03}")


def test_a_shell_completes_names(folder: Path) -> None:
    assert completions.captures("latest") == ["latest", "latest-1", "latest-2"]
    assert completions.captures("fe") == ["fetch-blue_can", "fetch-red_can"]


def test_a_path_is_a_path(folder: Path) -> None:
    (folder.parent / "fetch").write_text("a list of what to fetch")
    assert shelf.find("fetch").name == f"{RUN}-005-fetch-blue_can.mcap"
    assert shelf.find("./fetch") == Path("fetch")
    make(folder.parent, 9).rename(folder.parent / "latest")
    (folder.parent / "fetch.mcap").touch()
    for path in ("latest", "fetch.mcap"):
        assert shelf.find(path) == Path(path)
    for path in ("no/such/thing", "nothing.mcap", "/dev/null", str(folder)):
        assert shelf.find(path) == Path(path)
    (folder.parent / "stop").mkdir()
    assert shelf.find("stop").name == f"{RUN}-004-stop.mcap"


def test_what_is_neither_is_told_of(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "info", "fetsh"]) == exits.FAILED
    assert "fetsh cannot be read: No such file or directory; `cocoro capture list`" in capsys.readouterr().err


def test_the_list_says_what_happened_in_each(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "list", "--json"]) == exits.DONE
    found = {each["name"]: each for each in json.loads(capsys.readouterr().out)}
    assert list(found) == ["idle", "latest", "latest-1", "idle-1", "latest-2", "idle-2"]
    assert (found["latest"]["what"], found["latest"]["outcome"]) == ("fetch blue_can", "failed")
    assert found["latest-2"]["task_id"] == "fetch-2"
    assert not found["idle"]["closed"]
    assert main(["capture", "list"]) == exits.DONE
    shown = capsys.readouterr().out
    assert [line.split()[0] for line in shown.splitlines()[1:4]] == ["latest-2", "latest-1", "latest"]
    assert "6 captures" in shown
    assert "3 more, --all shows them" in shown


def test_a_recording_that_was_killed_still_says_which_task_it_began_with(folder: Path) -> None:
    make(folder, 7, "fetch green_can", "done", close=False)
    (newest,) = [each for each in shelf.listed() if each.name == "latest"]
    assert (newest.what, newest.closed) == ("fetch green_can", False)


def test_pinned_captures_are_kept_and_only_a_person_removes_one(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fetch, stop = shelf.find("fetch-1"), shelf.find("stop")
    assert main(["capture", "pin", "fetch red_can"]) == exits.DONE
    assert is_pinned(fetch)
    assert main(["capture", "remove", "stop", "fetch red_can", "--yes"]) == exits.REFUSED
    assert "is pinned" in capsys.readouterr().err
    assert main(["capture", "remove", "stop"]) == exits.REFUSED
    assert "repeat the command with --yes" in capsys.readouterr().err
    assert stop.exists()
    assert main(["capture", "unpin", "fetch-1"]) == exits.DONE
    assert main(["capture", "remove", "stop", str(fetch), "--yes"]) == exits.DONE
    assert not stop.exists()
    assert not fetch.exists()
    assert not list(folder.glob("*.pin"))


def test_commands_take_names(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "info", "fetch red_can", "--check", "--json"]) == exits.DONE
    assert json.loads(capsys.readouterr().out)["path"].endswith("-002-fetch-red_can.mcap")
    assert main(["capture", "info", "fetch"]) == exits.DONE
    assert re.search(r"^happened +fetch blue_can \(failed\)$", capsys.readouterr().out, re.MULTILINE)
    assert main(["replay", "stop"]) == exits.FAILED  # it names no robot
    assert f"{RUN}-004-stop.mcap: it names no robot" in capsys.readouterr().err


def test_a_run_up_to_a_file(folder: Path, tmp_path: Path) -> None:
    assert [path.name.removeprefix(RUN)[1:4] for path in shelf.run_until(folder / f"{RUN}-003-idle.mcap")] == [
        "001",
        "002",
        "003",
    ]
    assert shelf.run_until(tmp_path / "mine.mcap") == [tmp_path / "mine.mcap"]


def test_status_says_how_long_the_room_lasts() -> None:
    told = Recording(free_bytes=60 * 10**9, rate_bytes_per_s=1e9 / 3600, kept_bytes=3 * 10**9, keep_bytes=5 * 10**9)
    assert space(told) == "60.0 GB left, 60 hours at 1000 MB an hour; 3.0 GB kept of at most 5.0"
    assert space(Recording(free_bytes=10**9)) == "1.0 GB left"


def test_the_file_of_a_recorder_that_is_up_is_found_by_its_process(short_path: Path, tmp_path: Path) -> None:
    run_dir = RunDir("robbie", short_path / "robbie")
    run_dir.make()
    (claim,) = run_dir.claim("capture", ["capture"])
    try:
        with (tmp_path / "open.mcap").open("wb"):
            assert tmp_path / "open.mcap" in open_captures(run_dir)
        assert tmp_path / "open.mcap" not in open_captures(run_dir)
    finally:
        claim.release()


def test_what_is_being_written_stays_whatever_its_path_is_called(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("apps.cli.shelf.robots", lambda: [RunDir("robbie", folder)])
    monkeypatch.setattr("apps.cli.shelf.open_captures", lambda _: [folder / f"{RUN}-006-idle.mcap"])
    assert main(["capture", "remove", f"{RUN}-006-idle.mcap", "--yes"]) == exits.REFUSED
    assert "is being written" in capsys.readouterr().err
    assert main(["capture", "remove", f"{RUN}-001-idle.mcap", f"./{RUN}-001-idle.mcap", "--yes"]) == exits.DONE
    assert sorted(path.name[len(RUN) + 1 :][:3] for path in folder.glob("*.mcap")) == [
        "002",
        "003",
        "004",
        "005",
        "006",
    ]
