"""`cocoro --help` and `cocoro status` without the libraries of the other commands print what those would print."""

from __future__ import annotations

import subprocess
import sys
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

from apps.cli import help, help_page
from apps.cli.main import main
from cocoro.distributions import may_add_to

PAGE = Path(help.__file__).with_name(help.PAGE)
WIDTHS = (help.NARROWEST, 79, 80, 97, 120, 200)


def seen(text: str) -> list[list[tuple[str, str]]]:
    """What a terminal shows of each line: characters and their styles; a space has none that can be seen."""
    return [
        [(letter, style if letter != " " else "") for style, part in help.runs(line) for letter in part]
        for line in text.split("\n")
    ]


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text(encoding="utf-8") == help_page.page(), "make manual"


@pytest.mark.parametrize("width", WIDTHS)
def test_at_every_width_it_is_what_the_libraries_draw(width: int) -> None:
    assert help.folded(width, colour=False) == help_page.drawn(width, colour=False)
    assert seen(help.folded(width, colour=True)) == seen(help_page.drawn(width, colour=True))


@pytest.mark.parametrize(("name", "value"), [("COLUMNS", "50"), ("NO_COLOR", "1"), ("TERM", "dumb")])
def test_where_the_libraries_draw_in_another_way_they_do_it(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout", TextIOWrapper(BytesIO(), encoding="utf-8"))
    assert help.text() is not None
    monkeypatch.setenv(name, value)
    assert help.text() is None


def test_where_a_third_party_may_have_added_a_task_the_libraries_list_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.path", [*sys.path, str(tmp_path)])
    assert not may_add_to("cocoro.tasks")
    about = tmp_path / "greeter-1.0.dist-info"
    about.mkdir()
    assert not may_add_to("cocoro.tasks")
    (about / "entry_points.txt").write_text("[cocoro.tasks]\ngreet = greeter:GREET\n")
    assert may_add_to("cocoro.tasks")
    assert help.text() is None


def test_what_may_hold_distributions_in_another_form_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = tmp_path / "all.zip"
    archive.touch()
    monkeypatch.setattr("sys.path", [str(tmp_path / "missing")])
    assert not may_add_to("cocoro.tasks")
    monkeypatch.setattr("sys.path", [str(archive)])
    assert may_add_to("cocoro.tasks")


@pytest.mark.usefixtures("root")
@pytest.mark.parametrize("arguments", [["status"], ["status", "--json"]])
def test_without_a_robot_status_says_what_it_says_with_more_options(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 4
    quick = capsys.readouterr()
    assert "no robot is up" in quick.err
    assert "cocoro up sim" in quick.err
    from apps.cli.link import find
    from apps.cli.options import RobotChoice
    from cocoro.errors import MeshError

    with pytest.raises(MeshError) as slow:
        find(RobotChoice())
    assert str(slow.value) in quick.err


@pytest.mark.process
@pytest.mark.usefixtures("root")
@pytest.mark.parametrize("arguments", [["--help"], ["status"], ["stop", "--robot", "nobody"]])
def test_what_a_person_waits_for_first_imports_no_library(arguments: list[str]) -> None:
    code = (
        "import sys; from apps.cli.main import main; main(sys.argv[1:]); sys.stdout = sys.stderr; print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    modules = set(done.stderr.split())
    assert "apps.cli.main" in modules
    assert modules.isdisjoint({"asyncio", "typer", "rich", "msgspec", "numpy", "zenoh", "importlib.metadata"})
