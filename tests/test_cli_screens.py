"""Screens at the widths of terminals: nothing is wrapped by the terminal, and what matters most stays."""

from __future__ import annotations

from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from apps.cli import hz, status, top_view, topics
from apps.cli.terminal import Column, fields, table
from cocoro.messages import BaseState, Health, LoopHealth, PlannerStatus, TaskState, TopicHealth

WIDTHS = (80, 120, 200)
SENTENCE = "no frame for 3.2 s: the camera's cable is loose, or its service hangs; see `cocoro logs kinect`"


def at(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    monkeypatch.setattr("apps.cli.terminal.output_width", lambda: width)


def widest(text: str) -> int:
    return max(map(len, text.splitlines()))


ROWS = [
    ("perception/detections", "Detections", "30.0 Hz", "0", SENTENCE),
    ("arm/state", "ServoState", "50.0 Hz", "", ""),
]
COLUMNS = ("topic", Column("type", 1), Column("rate", right=True), Column("lost", 2, right=True), Column("", text=True))


def test_a_table_of_full_width_is_one_line_for_each_row() -> None:
    lines = table(COLUMNS, ROWS, 10_000).splitlines()
    assert [line.split()[0] for line in lines] == ["TOPIC", "perception/detections", "arm/state"]
    assert lines[1].endswith(SENTENCE)


def test_a_narrow_table_leaves_out_the_columns_of_the_highest_rank_first_and_names_them() -> None:
    text = table(COLUMNS, ROWS, 70)
    assert "LOST" not in text
    assert "Detections" in text
    assert text.endswith("(a wider terminal shows, too: lost)\n")


def test_a_column_that_is_empty_is_left_out_before_all_others_and_without_a_word() -> None:
    rows = [(*row[:3], "", row[4]) for row in ROWS]
    assert "wider" not in table(COLUMNS, rows, 70)


@pytest.mark.parametrize("width", [20, 30, 40, 60, 80, 120])
def test_what_does_not_fit_beside_the_other_columns_is_below_them_and_no_line_is_wider(width: int) -> None:
    text = table(COLUMNS, ROWS, width)
    assert widest(text) <= width
    assert "".join(SENTENCE.split()) in "".join(text.split())


def test_a_value_in_the_second_line_has_its_name() -> None:
    text = table(("object", "size (cm)", "graspable"), [("red_can", "6.6 x 12.0", "yes")], 20)
    assert text.splitlines()[1:] == ["red_can  6.6 x 12.0", "    graspable yes"]


@pytest.mark.parametrize("width", [30, 80])
def test_facts_are_folded_below_their_first_line(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    at(monkeypatch, width)
    text = fields([("planner", SENTENCE), ("none", ""), ("emergency stop", "released")])
    assert widest(text) <= width
    assert " ".join(text.split()) == f"planner {SENTENCE} emergency stop released"
    assert all(line.startswith((" " * 16, "planner", "emergency")) for line in text.splitlines())


# --- the commands -----------------------------------------------------------------------------------


def health(service: str, topics: tuple[TopicHealth, ...] = (), text: str = "") -> Health:
    loop = LoopHealth(name="loop", rate_hz=50.0, period_p99_ms=22.8, step_median_ms=1.5)
    return Health(service=service, pid=123_456, cpu_share=0.11, rss_mb=254.0, loops=(loop,), topics=topics, text=text)


def report() -> dict[str, Any]:
    import msgspec

    names = ("capture", "sim", "kinect", "base", "arm", "hand", "perception", "planning", "executive")
    services = []
    for name in names:
        data = msgspec.to_builtins(health(name, text=SENTENCE if name == "kinect" else ""))
        services.append(
            {"service": name, "process": name, "alive": True, "state": "ready", "silent_s": 0.1, "cpu_budget": 1.0,
             "rss_budget_mb": 400.0, "late_share": 0.02, "health": data}
        )  # fmt: skip
    reader = {"service": "perception", "rate_hz": 30.0, "age_s": 0.1, "skipped": 498, "lost": 3, "rejected": 0,
              "expired": 0, "growing": True, "last_error": ""}  # fmt: skip
    listed = [
        {"topic": f"{name}/detections", "publisher": name, "published": True, "count": 9, "rate_hz": 29.9,
         "nominal_hz": 30.0, "age_s": 0.02, "max_age_s": 1.0, "readers": [reader] * (name == "perception")}
        for name in names
    ]  # fmt: skip
    task = TaskState(task_id="1", task="fetch", label="red_can", phase="search", text=SENTENCE)
    return {
        "robot": "calliope", "profile": "sim", "clocks": [], "machine": {"cores": 2, "cpu_share": 0.5}, "clock": None,
        "task": msgspec.to_builtins(task),
        "plan": msgspec.to_builtins(PlannerStatus(behaviour="search", why=SENTENCE)), "latch": None, "recording": None,
        "base": msgspec.to_builtins(BaseState((0.0, 0.0), 0.0, 0.0, 0.0)), "services": services, "topics": listed,
    }  # fmt: skip


def drawn(width: int, height: int | None = None, told: dict[str, Any] | None = None) -> str:
    out = StringIO()
    screen = Console(file=out, width=width, height=height, color_system=None)
    screen.print(top_view.render(told or report(), None if height is None else screen))
    return out.getvalue()


@pytest.mark.parametrize("width", WIDTHS)
def test_top_shows_state_cost_rate_and_losses_at_every_width(width: int) -> None:
    text = drawn(width)
    assert widest(text) <= width
    assert "…" not in text.partition("SERVICE")[2]
    for head in ("SERVICE", "STATE", "CPU", "MEMORY", "TOPIC", "RATE", "NOMINAL", "AGE", "LOST", "REJECTED"):
        assert f"{head}" in text
    assert "perception/detections" in text


@pytest.mark.parametrize("width", WIDTHS)
def test_top_on_a_low_terminal_shows_the_topics_with_a_problem_and_counts_the_rest(width: int) -> None:
    text = drawn(width, 24)
    assert len(text.splitlines()) <= 24
    assert sum("/detections" in line for line in text.splitlines()) >= 4
    assert "perception/detections" in text
    assert "more; so does --once" in text


STARVED = (
    "this machine is short of processor time: of 10 s waited planning 40%, perception 31%, executive 22%; of its 2 "
    "cores took python -c while True: pass (pid 4711) 98%, sim (pid 4712) 61%"
)


@pytest.mark.parametrize("width", WIDTHS)
def test_top_says_all_of_who_takes_the_processor_below_the_emergency_stop(width: int) -> None:
    told = report() | {"latch": {"state": "latched", "by": "operator"}}
    told["machine"] |= {"starved": STARVED}
    text = drawn(width, 24, told)
    assert len(text.splitlines()) <= 24
    assert "".join(STARVED.split()) in "".join(text.split())
    assert text.index("EMERGENCY STOP latched") < text.index("short of processor time")


def test_services_of_one_process_say_the_same_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = report()
    for service in told["services"]:
        service["health"]["text"] = SENTENCE if service["service"] in ("sim", "kinect", "base") else ""
    at(monkeypatch, 200)
    status._print(told)
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert (lines["sim"].endswith(SENTENCE), lines["kinect"][-6:], lines["base"][-6:]) == (True, "as sim", "as sim")
    assert drawn(200, told=told).count(SENTENCE) == 2  # the task's, too


def test_a_replayed_service_is_neither_missing_nor_dead() -> None:
    told = report()
    told["services"][1] |= {"alive": False, "state": "replayed"}
    assert not status.missing(told)
    (line,) = (line for line in drawn(200, told=told).splitlines() if line.startswith("sim "))
    assert line.split() == ["sim", "replayed"]
    told["services"][1]["state"] = "not alive"
    assert status.missing(told)


@pytest.mark.parametrize("width", WIDTHS)
def test_status_hz_and_topics_fit(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    at(monkeypatch, width)
    status._print(report())
    print(topics.table())
    rate = hz.RateReport(
        "calliope/perception/detections",
        30.0,
        29.9,
        30.0,
        33.3,
        6.3,
        12.0,
        1010.5,
        5_800_000.0,
        384_100.0,
        150,
        3,
        9.5,
        "",
    )
    print(hz.rows([rate]))
    text = capsys.readouterr().out
    assert widest(text) <= width
    assert all(word in text for word in ("ready", "LOST", "nothing for 9.5 s", "search", "MAX AGE", "TIME-OUT"))
