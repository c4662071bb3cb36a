"""What `cocoro status` shows: the services that should run, their health, the task and the planner's reason.

Without options `apps/cli/main.py` calls it, so it does without the library that reads options.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from functools import partial
from typing import Any

import msgspec

from apps.cli import exits
from apps.cli.choice import RobotChoice
from apps.cli.link import REPLAYED, MeshLink, joined, within
from apps.cli.output import print_json
from apps.cli.terminal import Column, fields, print_table
from cocoro.errors import ConfigError
from cocoro.messages import Health, Message, Recording, TaskState
from cocoro.topics import BASE_STATE, HEALTH, LATCH, PLAN, RECORDING, TASK, Topic
from deploy import profiles

RECORDER = RECORDING.of("capture")
NEWS: tuple[Topic[Any], ...] = (PLAN, TASK, LATCH, BASE_STATE, RECORDER)
HEALTH_S = 2.5
"""Longest wait for the health of every live service; each publishes it once a second of the robot's time."""

COLUMNS = (
    "service", "state", Column("pid", 2, right=True), Column("cpu", right=True), Column("memory", right=True),
    Column("loop", 1, right=True), Column("", text=True),
)  # fmt: skip


async def show_status(choice: RobotChoice, as_json: bool) -> int:
    """Prints the report and returns the exit code. Raises MeshError when the robot's mesh is not there."""
    async with joined(choice) as link:
        report = await Survey(link).take()
    if as_json:
        print_json(report)
    else:
        _print(report)
    return exits.FAILED if missing(report) else exits.DONE


class Survey:
    """Collects the health of every live service and the newest state of task, plan, latch and base."""

    def __init__(self, link: MeshLink) -> None:
        self._link = link
        self._health: dict[str, Health] = {}
        self._newest: dict[str, Message] = {}
        self._changed = asyncio.Event()

    async def take(self) -> dict[str, Any]:
        self._link.inbox(HEALTH.of("*")).add(lambda _key, health: self._on_health(health))
        for topic in NEWS:
            self._link.inbox(topic).add(partial(self._on_news, topic.name))
        alive = set(await self._link.alive())
        there = alive | self._link.replayed()
        wanted_news = {topic.name for topic in NEWS if topic.service in there}
        asking = [asyncio.ensure_future(self._ask(topic)) for topic in (HEALTH.of("*"), *NEWS) if topic.slow]
        await within(HEALTH_S, lambda: there <= set(self._health) and wanted_news <= set(self._newest), self._changed)
        for question in asking:
            question.cancel()
        await asyncio.gather(*asking, return_exceptions=True)
        return self._report(alive, there)

    async def _ask(self, topic: Topic[Any]) -> None:
        """Ask for messages that may not come of themselves for a second; one that came meanwhile is newer."""
        for message in await self._link.newest(topic, HEALTH_S):
            if isinstance(message, Health):
                self._health.setdefault(message.service, message)
            else:
                self._newest.setdefault(topic.name, message)
        self._changed.set()

    def _on_health(self, health: Health) -> None:
        self._health[health.service] = health
        self._changed.set()

    def _on_news(self, topic: str, _key: str, message: Message) -> None:
        self._newest[topic] = message
        self._changed.set()

    def _report(self, alive: set[str], there: set[str]) -> dict[str, Any]:
        resolved = self._link.run_dir.resolved()
        names = list(dict.fromkeys([*expected(resolved), *sorted(there)]))
        return {
            "robot": self._link.robot,
            "profile": resolved.get("name", ""),
            "services": [
                {"service": name, "alive": name in alive, "state": self._state(name, name in alive)}
                | ({"health": msgspec.to_builtins(self._health[name])} if name in self._health else {})
                for name in names
            ],
            "task": self._newest_of(TASK.name),
            "plan": self._newest_of(PLAN.name),
            "latch": self._newest_of(LATCH.name),
            "base": self._newest_of(BASE_STATE.name),
            "recording": self._newest_of(RECORDER.name),
        }

    def _state(self, service: str, alive: bool) -> str:
        if not alive:
            return self._link.unheard(service)
        if service in self._health:
            return self._health[service].state
        return REPLAYED if service in self._link.replayed() else "no report"

    def _newest_of(self, topic: str) -> Any:
        return msgspec.to_builtins(self._newest[topic]) if topic in self._newest else None


def missing(report: dict[str, Any]) -> bool:
    """Whether a service of a report is missing: it is not alive, and no replay stands for it."""
    return not all(service["alive"] or service["state"] == REPLAYED for service in report["services"])


def expected(resolved: dict[str, Any]) -> tuple[str, ...]:
    """Services that should be alive by `resolved`, the profile of the robot's last start."""
    try:
        return profiles.from_data(resolved, resolved.get("name", "")).services() if resolved else ()
    except ConfigError:  # a component has been uninstalled since
        return ()


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
    if report["task"] is not None:
        yield "task", _task(msgspec.convert(report["task"], TaskState))
    if (plan := report["plan"]) is not None:
        yield "planner", ": ".join(filter(None, (plan["behaviour"], plan["why"])))
        yield "reaches with", plan["model"]
    if (told := report["recording"]) is not None:
        recording = msgspec.convert(told, Recording)
        yield "records", recording.fault or f"{recording.occasion or 'nothing that happens'}, in {recording.file}"
        yield "space", space(recording)


def space(recording: Recording) -> str:
    """Room left for captures, and the time for which it lasts."""
    if recording.fault:
        return ""
    rate = recording.rate_bytes_per_s
    hours = f", {recording.free_bytes / rate / 3600:.0f} hours at {3600 * rate / 1e6:.0f} MB an hour" if rate else ""
    kept = ""
    if recording.keep_bytes is not None:
        kept = f"; {recording.kept_bytes / 1e9:.1f} GB kept of at most {recording.keep_bytes / 1e9:.1f}"
    return f"{recording.free_bytes / 1e9:.1f} GB left{hours}{kept}"


def _task(task: TaskState) -> str:
    if not task.task_id:
        return "none yet"
    name = f"{task.task} {task.label}".strip()
    if task.outcome is None:
        return f"{name}, {task.phase}, {task.elapsed_s:.1f} s"
    return f"{name}: {task.outcome} after {task.elapsed_s:.1f} s{f' ({task.reason})' if task.reason else ''}"
