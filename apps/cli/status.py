"""`cocoro status`: shows the services that should run, their health, the task and the planner's reason.

A robot's supervisor knows all that and is asked for it. Where none answers, the command joins the mesh and collects it
(`deploy.survey`). Without options `apps/cli/main.py` calls it, so it does without the library that reads options, and
the first way imports little.
"""

from __future__ import annotations

import json
from types import SimpleNamespace

from apps.cli import exits
from apps.cli.output import print_json
from apps.cli.terminal import Column, fields, print_table
from deploy.site import clock_words

TYPE_CHECKING = False
"""As in `typing`, which takes 2 ms to import."""
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from apps.cli.asked import Asked
    from apps.client.choice import RobotChoice

REPLAYED = "replayed"
"""As in `deploy.survey`, which is slow to import; a test compares them."""

COLUMNS = (
    "service", "state", Column("pid", 2, right=True), Column("cpu", right=True), Column("memory", right=True),
    Column("loop", 1, right=True), Column("", text=True),
)  # fmt: skip


def show_told(asked: Asked, as_json: bool) -> int | None:
    """Prints the report of the robot's supervisor and returns the exit code; None when it does not answer."""
    report = told_by_supervisor(asked)
    return None if report is None else _show(report, as_json)


def told_by_supervisor(asked: Asked) -> dict[str, Any] | None:
    """The report of the robot's supervisor; None when it does not answer."""
    try:
        report = json.loads(asked.answer())
    except ValueError:
        return None
    return report if isinstance(report, dict) else None


async def show_status(choice: RobotChoice, as_json: bool) -> int:
    """Collects and prints the report and returns the exit code. Raises MeshError when the robot's mesh is not there."""
    from apps.cli.link import joined
    from deploy.survey import Survey

    async with joined(choice) as link:
        report = await Survey(link).take(set(await link.alive()))
    return _show(report, as_json)


def _show(report: dict[str, Any], as_json: bool) -> int:
    if as_json:
        print_json(report)
    else:
        _print(report)
    return exits.FAILED if missing(report) else exits.DONE


def missing(report: dict[str, Any]) -> bool:
    """Whether a service of a report is missing: it is not alive, and no replay stands for it."""
    return not all(service["alive"] or service["state"] == REPLAYED for service in report["services"])


def _print(report: dict[str, Any]) -> None:
    rows = []
    told: dict[tuple[str, int], str] = {}
    for service in report["services"]:
        health = service.get("health")
        if health is None:
            rows.append((service["service"], service["state"], "", "", "", "", ""))
            continue
        text = said(health, service["service"], told)
        loop = max(health["loops"], key=lambda loop: loop["rate_hz"], default=None)
        rows.append(
            (
                service["service"],
                service["state"],
                str(health["pid"]),
                f"{100 * health['cpu_share']:.0f}%",
                f"{health['rss_mb']:.0f} MB",
                "" if loop is None else f"{loop['rate_hz']:.1f} Hz",
                text,
            )
        )
    print(f"{report['robot']}{f' (profile {name})' if (name := report['profile']) else ''}\n")
    print_table(COLUMNS, rows)
    print()
    print(fields(_facts(report)), end="")


def said(health: dict[str, Any], service: str, told: dict[tuple[str, int], str]) -> str:
    """A service's text and faults; 'as sim' when another service of its process, in `told`, has said the same."""
    text = "; ".join(filter(None, (health["text"], *health["faults"])))
    by = told.setdefault((text, health["pid"]), service)
    return text if not text or by == service else f"as {by}"


def _facts(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if (latch := report["latch"]) is not None:
        yield "emergency stop", f"{latch['state']}{f' by {name}' if (name := latch['by']) else ''}"
    if (base := report["base"]) is not None:
        yield "battery", f"{100 * base['battery_fraction']:.0f}%{', charging' if base['charging'] else ''}"
    if clocks := said_of_clocks(report["clocks"]):
        yield "clocks", clocks
    if report["task"] is not None:
        yield "task", _task(SimpleNamespace(**report["task"]))
    if (plan := report["plan"]) is not None:
        yield "planner", ": ".join(filter(None, (plan["behaviour"], plan["why"])))
        yield "reaches with", plan["model"]
    if (told := report["recording"]) is not None:
        recording = SimpleNamespace(**told)
        yield "records", recording.fault or f"{recording.occasion or 'nothing that happens'}, in {recording.file}"
        yield "space", space(recording)


def said_of_clocks(offsets: list[dict[str, Any]]) -> str:
    """The clocks of a site's hosts; '' where there is no site."""
    return "; ".join(filter(None, (clock_words.said(SimpleNamespace(**one)) for one in offsets)))


def space(recording: Any) -> str:
    """Room left for captures, and the time for which it lasts; of a `Recording`."""
    if recording.fault:
        return ""
    rate = recording.rate_bytes_per_s
    hours = f", {recording.free_bytes / rate / 3600:.0f} hours at {3600 * rate / 1e6:.0f} MB an hour" if rate else ""
    kept = ""
    if recording.keep_bytes is not None:
        kept = f"; {recording.kept_bytes / 1e9:.1f} GB kept of at most {recording.keep_bytes / 1e9:.1f}"
    return f"{recording.free_bytes / 1e9:.1f} GB left{hours}{kept}"


def _task(task: Any) -> str:
    if not task.task_id:
        return "none yet"
    name = f"{task.task} {task.label}".strip()
    if task.outcome is None:
        return f"{name}, {task.phase}, {task.elapsed_s:.1f} s"
    return f"{name}: {task.outcome} after {task.elapsed_s:.1f} s{f' ({task.reason})' if task.reason else ''}"
