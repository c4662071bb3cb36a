"""Draws the report of `cocoro top`: a headline, a table of services, a table of topics."""

from __future__ import annotations

from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from apps.cli.status import said, said_of_clocks
from apps.cli.terminal import PLAIN_WIDTH, Column, FittedTable
from deploy.survey import REPLAYED

SLOW, STALLED = 0.85, 0.4
"""Shares of the nominal rate: one below SLOW, or as far above 1, is yellow, one below STALLED red."""
LATE, VERY_LATE = 0.01, 0.1
"""Shares of a loop's periods without a step that are yellow and red."""
OTHER_LINES = 7
"""Lines of the screen beside services and topics: the headline's two, two blank ones, the topics' head, and two that
tell what is left out."""
BAD, DOUBTFUL, GOOD, FAINT = "bold red", "yellow", "green", "dim"
COUNTED = ("skipped", "lost", "rejected", "expired")
WORDS = {"expired": "late"}
"""How a count is called here, where not by its name."""
SERVICES = (
    "service", "state", Column("pid", 4, right=True), Column("cpu", right=True), Column("memory", right=True),
    Column("loop", right=True), Column("p99", 2, right=True), Column("step", 3, right=True),
    Column("late", right=True), Column("up", 5, right=True), Column("", text=True),
)  # fmt: skip
TOPICS = (
    "topic", Column("from", 3), Column("rate", right=True), Column("nominal", right=True), Column("age", right=True),
    Column("skipped", right=True), Column("lost", right=True), Column("rejected", right=True),
    Column("late", right=True),
    Column("read by", 2, text=True),
)  # fmt: skip


class Screen:
    """Shows reports on the whole terminal while the context lasts."""

    def __init__(self) -> None:
        self._live = Live(auto_refresh=False, screen=True, vertical_overflow="crop")

    def __enter__(self) -> Screen:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, report: dict[str, Any]) -> None:
        self._live.update(render(report, self._live.console), refresh=True)


def print_report(report: dict[str, Any]) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH)
    console.print(render(report))


def render(report: dict[str, Any], screen: Console | None = None) -> RenderableType:
    """The whole report; for a `screen` only topics that have a rate or a problem, as many as have room on it."""
    topics, hidden = report["topics"], list[Text]()
    words = report["machine"].get("starved", "")
    notes = [Text(words, BAD)] if words else []  # folded: the end of the sentence says who takes the processor
    if clocks := said_of_clocks(report["clocks"]):
        notes.append(
            Text(f"clocks: {clocks}", BAD if any(one["state"] == "refused" for one in report["clocks"]) else "")
        )
    needed = len(report["services"]) + len(topics) + 2 * OTHER_LINES
    services = _services(report["services"], fold=screen is None or screen.height > needed)
    if screen is None:
        room = len(topics)
    else:
        fixed = Group(*notes, services)
        room = max(screen.height - len(screen.render_lines(fixed, pad=False)) - OTHER_LINES, 1)
    if room < len(topics):
        topics = sorted(filter(_is_busy, topics), key=lambda topic: not _is_troubled(topic))[:room]
        more = len(report["topics"]) - len(topics)
        hidden = [Text(f"(a higher terminal shows {more} more; so does --once)", FAINT)]
    return Group(_headline(report), *notes, Text(), services, Text(), _topics(topics), *hidden)


def _is_busy(topic: dict[str, Any]) -> bool:
    return topic["nominal_hz"] is not None or _is_troubled(topic)


def _is_troubled(topic: dict[str, Any]) -> bool:
    return any(reader["growing"] and (reader["lost"] or reader["rejected"]) for reader in topic["readers"])


# --- headline -------------------------------------------------------------------------------------


def _headline(report: dict[str, Any]) -> Text:
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append(report["robot"], "bold")
    if report["profile"]:
        text.append(f" ({report['profile']})")
    if (latch := report["latch"]) is not None and latch["state"] != "released":
        text.append(f"  EMERGENCY STOP {latch['state']}", BAD)  # first, so that no width cuts it
    machine = report["machine"]
    used = machine["cpu_share"]
    text.append(f"  cpu {'unknown (no /proc)' if used is None else f'{100 * used:.0f}%'} of {machine['cores']} cores")
    if (clock := report["clock"]) is not None:
        slow = clock["paused"] or clock["rate"] < SLOW
        rate = "stands" if clock["paused"] else f"x{clock['rate']:.2f}"
        text.append(f"  clock {clock['stamp_ns'] / 1e9:.1f} s {rate}", DOUBTFUL if slow else "")
    if (base := report["base"]) is not None:
        text.append(f"  battery {100 * base['battery_fraction']:.0f}%")
    text.append("\n")
    task, plan = report["task"], report["plan"]
    if task is not None and task["task_id"]:
        name = f"{task['task']} {task['label']}".strip()
        outcome = f"{task['outcome']} after" if task["outcome"] else f"{task['phase']},"
        text.append(f"{name}: {outcome} {task['elapsed_s']:.1f} s", "bold")
        text.append(f"  {task['reason'] or task['text']}")
    elif plan is not None:
        text.append(f"{plan['behaviour']}  {plan['why']}")
    return text


# --- services -------------------------------------------------------------------------------------


BAD_STATES = ("not alive", "no contact", "no report")


def _services(services: list[dict[str, Any]], fold: bool) -> FittedTable:
    shown: dict[int, str] = {}
    told: dict[tuple[str, int], str] = {}
    return FittedTable(SERVICES, [_service(service, shown, told) for service in services], fold=fold)


def _service(service: dict[str, Any], shown: dict[int, str], told: dict[tuple[str, int], str]) -> list[str | Text]:
    health = service["health"]
    style = BAD if service["state"] in BAD_STATES else GOOD if service["state"] == "ready" else DOUBTFUL
    state = Text(service["state"] or "?", style)
    if health is None:
        return [service["service"], state, *[""] * 9]
    loop = max(health["loops"], key=lambda loop: loop["rate_hz"], default=None)
    text = said(health, service["service"], told)
    if service["state"] == "no report" and service["silent_s"] is not None:
        text = f"no report of its health for {service['silent_s']:.0f} s"
    pid = health["pid"]
    costs: list[str | Text]
    if pid in shown:  # several services in one process: its cost is shown once
        costs = [Text(str(pid), FAINT), Text(f"as {shown[pid]}", FAINT), ""]
    else:
        shown[pid] = service["service"]
        costs = [
            str(pid),
            _cost(100 * health["cpu_share"], 100 * (service["cpu_budget"] or 0), "%"),
            _cost(health["rss_mb"], service["rss_budget_mb"] or 0, " MB"),
        ]
    was = {"not alive": f"was {pid}", REPLAYED: ""}.get(service["state"], f"pid {pid}")
    row = [
        service["service"], state, *costs,
        "" if loop is None else f"{loop['rate_hz']:.1f} Hz",
        "" if loop is None else f"{loop['period_p99_ms']:.1f} ms",
        "" if loop is None else f"{loop['step_median_ms']:.1f} ms",
        _late(service.get("late_share")),
        _duration(health["uptime_s"]), text,
    ]  # fmt: skip
    return row if service["alive"] else [row[0], row[1], *[""] * 8, Text(was, FAINT)]


def _late(share: float | None) -> Text:
    if share is None:
        return Text("")
    style = BAD if share > VERY_LATE else DOUBTFUL if share > LATE else FAINT if share == 0 else ""
    return Text(f"{share:.0%}", style)


def _cost(value: float, budget: float, unit: str) -> Text:
    return Text(f"{value:.0f}{unit}", BAD if budget and value > budget else "")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


# --- topics ---------------------------------------------------------------------------------------


def _topics(topics: list[dict[str, Any]]) -> FittedTable:
    return FittedTable(TOPICS, map(_topic, topics))


def _topic(topic: dict[str, Any]) -> list[str | Text]:
    readers = topic["readers"]
    idle = topic["count"] == 0
    rate = Text("-", FAINT) if idle else _rate(topic["rate_hz"], topic["nominal_hz"])
    nominal = "" if topic["nominal_hz"] is None else f"{topic['nominal_hz']:g}"
    counts = [_count(readers, what) for what in COUNTED]
    publisher = topic["publisher"] if topic["published"] else f"({topic['publisher'] or 'nobody'})"
    return [
        Text(topic["topic"], FAINT if idle else ""),
        Text(publisher, "" if topic["published"] else FAINT),
        rate,
        Text(nominal, FAINT),
        _age(topic),
        *counts,
        _read_by(readers),
    ]


def _rate(rate_hz: float, nominal_hz: float | None) -> Text:
    share = 1.0 if not nominal_hz else rate_hz / nominal_hz
    return Text(f"{rate_hz:.1f} Hz", BAD if share < STALLED else DOUBTFUL if not SLOW <= share <= 2 - SLOW else "")


def _age(topic: dict[str, Any]) -> Text:
    """Age of the newest message when its publisher last reported; red when it is too old for a reader to act on."""
    age_s = topic["age_s"]
    if age_s is None:
        return Text("")
    regular = topic["nominal_hz"] is not None
    late = regular and topic["max_age_s"] is not None and age_s > topic["max_age_s"]
    return Text(f"{1e3 * age_s:.0f} ms" if age_s < 10 else f"{age_s:.0f} s", BAD if late else "" if regular else FAINT)


def _count(readers: list[dict[str, Any]], what: str) -> Text:
    """Sum over all readers since they started; red when it grows. Skipping outdated state is no fault, so never red."""
    total = sum(reader[what] for reader in readers)
    if not total:
        return Text("0" if readers else "", FAINT)
    grows = what != "skipped" and any(reader[what] and reader["growing"] for reader in readers)
    return Text(str(total), "" if not grows else DOUBTFUL if what == "expired" else BAD)


def _read_by(readers: list[dict[str, Any]]) -> Text:
    """The readers; with several, what each missed; and why the last message was rejected."""
    text = Text(no_wrap=True, overflow="ellipsis")
    for number, reader in enumerate(readers):
        text.append(", " if number else "")
        text.append(reader["service"])
        missed = [f"{reader[what]} {WORDS.get(what, what)}" for what in COUNTED if reader[what]]
        if missed and len(readers) > 1:
            text.append(f" ({', '.join(missed)})", FAINT)
        if reader["rejected"] and reader["last_error"]:
            text.append(f" [{reader['last_error']}]", BAD)
    return text
