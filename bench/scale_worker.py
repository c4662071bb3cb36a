"""Speaks for some of a site's hosts or for its persons, without robots: `python -m bench.scale_worker OPTIONS`.

`OPTIONS` is one JSON object. A process of hosts keeps the schedule of their topics, answers their requests and counts
what comes; one of a person listens, and stops robots when a line on its standard input says so. Everything that it says
is one JSON object per line.

`direct`: a host's session is a client of the hub. `gateways`: it is a peer on the host's own mesh, where a router
session with the host's compiled rules passes on what crosses to the hub, as the gateway process does; here it is in
this process, since a hundred processes would be too many for a small machine.
"""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import Callback

from bench import scale_site
from bench.mesh_process import STAMP_BYTES, stamp
from cocoro.bus.declared import QOS
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.register import Membership, new_identity
from cocoro.bus.router import LEASE_S, RETRY_MS, Router
from cocoro.bus.session import open_session, options
from cocoro.clock import steady_ns
from cocoro.messages import EstopRequest
from cocoro.topics import BASE_COMMAND, BASE_STATE, ESTOP, TASK
from deploy.rundir import RunDir
from deploy.site import admitted, credentials, place, plan
from deploy.site.component import PREFIX
from deploy.site.plan import Site
from deploy.site.rules import compiled

LATE_NS = 20_000_000
"""A message whose time is longer ago than this, one period of a command, is left out and counts as late: a service that
falls behind does not catch up in a burst either."""
STOP_S = 5.0
OF_GATEWAYS = f"/{PREFIX}"
ANSWER = b"\x80"
NS = 1_000_000_000


def say(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def counter(heard: Counter[str], name: str, *, whole: bool = False) -> Callback[zenoh.Sample]:
    """Counts what comes; of a `whole` robot without what a real gateway says of itself, which is in no schedule."""

    def on_sample(sample: zenoh.Sample) -> None:
        if not (whole and OF_GATEWAYS in str(sample.key_expr)):
            heard[name] += 1

    return Callback(on_sample, indirect=False)


class Speakers:
    """The hosts of one process."""

    def __init__(self, given: dict[str, Any]) -> None:
        self._given = given
        self._site: Site = plan.read(Path(given["site"]))
        self._admitted = admitted.read(self._site.folder)
        self._heard: Counter[str] = Counter()
        self._recorded: Counter[str] = Counter()
        self._took_ns: list[int] = []
        self._kept: list[Any] = []
        self._due: list[tuple[int, zenoh.Publisher, bytes, str]] = []

    async def open(self) -> None:
        for host in self._given["hosts"]:
            session = await (self._client(host) if self._given["direct"] else self._member(host))
            self._declare(host, session)
            self._kept.append(session)
        self._due.sort(key=lambda row: row[0])

    async def _client(self, host: str) -> zenoh.Session:
        return client(self._site, host)

    async def _member(self, host: str) -> zenoh.Session:
        run_dir = RunDir(self._site.hosts[host].robot, Path(self._given["run"]) / host)
        run_dir.make()
        if host not in self._given["real"]:
            now = datetime.now(UTC)
            mine = credentials.read(self._site.folder / place.CREDENTIALS / host, now)
            names = {name: self._admitted.common_names(name, now) for name in self._admitted.names}
            rules = compiled(self._site, host, names)
            self._kept.append(
                await Router.open("gateway", run_dir.path, (), self._site.endpoints(host), {**mine.options, **rules})
            )
        membership = Membership.register(run_dir.path, "speaker")
        config = ZenohConfig("speaker", directory=run_dir.path)
        chosen = options(config, membership.member.identity, membership.listen, membership.connect)
        self._kept.append(membership)
        return open_session(config, chosen).session

    def _declare(self, host: str, session: zenoh.Session) -> None:
        robot = self._site.hosts[host].robot
        share = scale_site.share_of(self._site, host)
        rates = [topic.rate_hz or 0.0 for topic in share.publishes]
        phase_ns = int(self._given["phase"][host] * NS / 50)
        rows = []
        for topic in share.publishes:
            publisher = session.declare_publisher(topic.key(robot), **QOS[topic.qos])
            rows.append((publisher, bytes(scale_site.size(topic.name) - STAMP_BYTES), topic.key(robot)))
        self._due += [(due.at_ns, *rows[due.topic]) for due in scale_site.schedule(rates, phase_ns)]
        self._kept += [row[0] for row in rows]
        for name in share.reads:
            key = f"{robot}/{name}"
            callback = self._on_command() if name == BASE_COMMAND.name else counter(self._heard, key)
            self._kept.append(session.declare_subscriber(key, callback, allowed_origin=zenoh.Locality.REMOTE))
        if share.records:
            callback = counter(self._recorded, robot, whole=True)
            self._kept.append(session.declare_subscriber(f"{robot}/**", callback, allowed_origin=zenoh.Locality.REMOTE))
        for name in share.serves:
            self._kept.append(session.declare_queryable(f"{robot}/{name}", answering(f"{robot}/{name}")))
        for name in share.shows:
            self._kept.append(session.liveliness().declare_token(f"{robot}/{name}"))

    def _on_command(self) -> Callback[zenoh.Sample]:
        def on_sample(sample: zenoh.Sample) -> None:
            self._took_ns.append(steady_ns() - stamp(sample.payload.to_bytes()))

        return Callback(on_sample, indirect=False)

    def speak(self, begin_ns: int, seconds: int) -> dict[str, Any]:
        """Keeps the schedule for some seconds; returns what was sent."""
        sent: Counter[str] = Counter()
        late = 0
        used_s = time.process_time()
        for second in range(seconds):
            base_ns = begin_ns + second * scale_site.PERIOD_NS
            for at_ns, publisher, rest, key in self._due:
                now_ns = steady_ns()
                if (wait_ns := base_ns + at_ns - now_ns) > 0:
                    time.sleep(wait_ns / NS)
                    now_ns = steady_ns()
                elif wait_ns < -LATE_NS:
                    late += 1
                    continue
                publisher.put(now_ns.to_bytes(STAMP_BYTES, "little") + rest)
                sent[key] += 1
        time.sleep(max(0.0, (begin_ns + seconds * NS - steady_ns()) / NS))
        took_s = max(1e-9, (steady_ns() - begin_ns) / NS)
        return {"sent": sent, "late": late, "cpu_s": time.process_time() - used_s, "took_s": took_s}

    def heard(self) -> dict[str, Any]:
        """What has come since it was asked last."""
        found = {"heard": dict(self._heard), "recorded": dict(self._recorded), "took_ns": [*self._took_ns]}
        self._heard.clear()
        self._recorded.clear()
        self._took_ns.clear()
        return found


def answering(key: str) -> Callback[zenoh.Query]:
    def on_query(query: zenoh.Query) -> None:
        with query:
            query.reply(key, ANSWER)

    return Callback(on_query, indirect=False)


def client(site: Site, name: str) -> zenoh.Session:
    """A session that is a client of the hub, and connects again whenever it has lost it."""
    mine = credentials.read(site.folder / place.CREDENTIALS / name, datetime.now(UTC))
    retry = {"period_init_ms": RETRY_MS[0], "period_max_ms": RETRY_MS[1], "period_increase_factor": 2}
    more = {"connect/timeout_ms": -1, "connect/exit_on_failure": False, "connect/retry": retry}
    config = ZenohConfig(
        name, mode="client", connect=site.endpoints(name), lease_s=LEASE_S, options={**mine.options, **more}
    )
    return open_session(config, options(config, new_identity(), [], list(config.connect))).session


class Person:
    """The operator, who sees each robot's base and task, or a viewer of everything of one robot."""

    def __init__(self, given: dict[str, Any]) -> None:
        self._site = plan.read(Path(given["site"]))
        self._name: str = given["person"]
        self._session = client(self._site, self._name)
        self._robots = self._site.robots_of(self._name)
        self._heard: Counter[str] = Counter()
        self._first_ns: dict[str, int] = {}
        self._kept: list[Any] = []
        for robot in self._robots:
            if self._name == scale_site.VIEWER:
                self._listen(f"{robot}/**", counter(self._heard, robot, whole=True))
            else:
                self._listen(BASE_STATE.key(robot), self._on_base(robot))
                self._listen(TASK.key(robot), counter(self._heard, TASK.key(robot)))

    def _listen(self, key: str, callback: Callback[zenoh.Sample]) -> None:
        self._kept.append(self._session.declare_subscriber(key, callback))

    def _on_base(self, robot: str) -> Callback[zenoh.Sample]:
        key = BASE_STATE.key(robot)

        def on_sample(_: zenoh.Sample) -> None:
            self._heard[key] += 1
            if robot not in self._first_ns:
                self._first_ns[robot] = steady_ns()

        return Callback(on_sample, indirect=False)

    def forget(self) -> None:
        """From now on `first` is anew."""
        self._first_ns.clear()

    def first(self) -> dict[str, int]:
        """When each robot's base was first heard since `forget`, ns."""
        return dict(self._first_ns)

    def heard(self) -> dict[str, int]:
        """What has come since it was asked last."""
        found = dict(self._heard)
        self._heard.clear()
        return found

    def stop(self, robots: list[str]) -> dict[str, Any]:
        """Stops robots, all at once; says how long until the last acknowledgement, and how many came."""
        payload = msgspec.msgpack.encode(EstopRequest(by=self._name))
        answers: list[int] = []
        ended = [threading.Event() for _ in robots]

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answers.append(steady_ns())

        begun_ns = steady_ns()
        for robot, event in zip(robots, ended, strict=True):
            self._session.get(
                ESTOP.of("*").key(robot), Callback(on_reply, event.set, indirect=False), payload=payload,
                timeout=STOP_S, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE,
            )  # fmt: skip
        for event in ended:
            event.wait(STOP_S + 1.0)
        return {"answers": len(answers), "took_ns": (max(answers) - begun_ns) if answers else 0}


def orders() -> Iterator[dict[str, Any]]:
    for line in sys.stdin:
        yield json.loads(line)


def serve_person(given: dict[str, Any]) -> None:
    person = Person(given)
    say(ready=True)
    for order in orders():
        match order["do"]:
            case "stop":
                say(**person.stop(order["robots"]))
            case "forget":
                person.forget()
                say()
            case "first":
                say(first=person.first())
            case "heard":
                say(heard=person.heard())
            case _:
                break


def serve_hosts(given: dict[str, Any]) -> None:
    speakers = Speakers(given)
    with asyncio.Runner() as runner:
        runner.run(speakers.open())
        say(ready=True)
        for order in orders():
            match order["do"]:
                case "speak":
                    say(**speakers.speak(order["begin_ns"], order["seconds"]))
                case "heard":
                    say(**speakers.heard())
                case _:
                    break


async def opened(given: dict[str, Any]) -> dict[str, float]:
    """How long a hub takes to read its site, to compile its rules and to open, s; and the bytes of its rules."""
    marks = [time.monotonic()]
    cpu = [time.process_time()]

    def mark() -> None:
        marks.append(time.monotonic())
        cpu.append(time.process_time())

    site = plan.read(Path(given["site"]))
    now = datetime.now(UTC)
    known = admitted.read(site.folder)
    mine = credentials.read(site.folder / place.CREDENTIALS / scale_site.HUB, now)
    names = {name: known.common_names(name, now) for name in known.names}
    mark()
    rules = compiled(site, scale_site.HUB, names)
    mark()
    run_dir = RunDir("opened", Path(given["run"]))
    run_dir.make()
    router = await Router.open(
        "gateway", run_dir.path, [f"tls/127.0.0.1:{given['port']}"], (), {**mine.options, **rules}
    )
    mark()
    await router.close()
    found = {"rules_bytes": float(len(json.dumps(rules)))}
    for index, what in enumerate(("read", "compile", "open")):
        found |= {f"{what}_s": marks[index + 1] - marks[index], f"{what}_cpu_s": cpu[index + 1] - cpu[index]}
    return found


def main() -> None:
    given = json.loads(sys.argv[1])
    match given["as"]:
        case "hosts":
            serve_hosts(given)
        case "person":
            serve_person(given)
        case "hub":
            with asyncio.Runner() as runner:
                say(**runner.run(opened(given)))


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    import os

    os._exit(0)  # hundreds of sessions take seconds to close, and nobody waits for them
