"""The gateway: joins this host's share of a robot with the other hosts of its site.

It is a member of the robot's private mesh on this machine, and a router with TLS links to the other hosts, which it
admits by certificate and by the rules compiled from the site's plan (`deploy.site.rules`). When the plan or the
admissions change, or this host's clock becomes wrong or right, it opens its router anew, since zenoh's rules cannot
change while it runs. It also corrects this host's time (`deploy.site.timekeeping`).

Nothing on this machine needs it to live: the processes here stay connected with each other. What came from other hosts
stops, as it does when the network is cut.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from cocoro.bus.router import Link, Router
from cocoro.component import Implementation
from cocoro.errors import CocoroError, ConfigError
from cocoro.node import Node
from cocoro.topics import ARM_STATE, BASE_STATE, FRAME, HAND_STATE
from deploy import robot_time
from deploy.rundir import RunDir
from deploy.site import admitted, credentials, place, plan
from deploy.site.plan import Site
from deploy.site.refusals import Refusal, Watch
from deploy.site.rights import of_clocks
from deploy.site.rules import compiled
from deploy.site.throttle import ALLOWED_BYTES_S, PERIOD_S, Throttle
from deploy.site.timekeeping import Timekeeping, tell_time

LOOK_S = 1.0
"""How often the gateway looks whether the plan, the admissions or the trust in this host's clock have changed."""
TELL_S = 10.0
"""A refusal that repeats is logged at its first time, and then counted and logged this often."""
SHOWN = 3
"""Refusals in health, the most frequent ones."""
KINDS = 1000
"""Different refusals of one sender that are counted apart. Who tries more than that hides his own alone."""
TOO_MUCH = f"more than {ALLOWED_BYTES_S / 1e6:g} MB a second, which are held back"
MEASURED = (FRAME, BASE_STATE, ARM_STATE, HAND_STATE)
"""What is fused by its time stamps."""
MEASURES_MS, ELSE_MS = 5.0, 40.0
"""By how much the clock may be off of a host that measures, and of another one, whose clock only says how old commands
are; docs/sites.md says where the limits come from."""

log = logging.getLogger("cocoro.gateway")


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the gateway; `cocoro up --site DIR --host NAME` fills them in."""

    site: str = ""
    """The folder of the site."""
    host: str = ""
    """The name of this host there."""
    clock_limit_ms: Annotated[float, Meta(gt=0)] | None = None
    """A host whose clock may be off by more is refused; None: `MEASURES_MS` or `ELSE_MS`, by what it does."""


class Gateway:
    """The gateway's work; `run` never returns."""

    def __init__(self, node: Node, config: Config, directory: Path) -> None:
        self._node = node
        self._config = config
        self._folder = Path(config.site)
        self._host = config.host
        self._directory = directory
        self._links: dict[str, Link] = {}
        self._hosts: frozenset[str] = frozenset()
        self._admitted: frozenset[str] = frozenset()
        self._odd: list[str] = []
        self._refused: Counter[Refusal] = Counter()
        self._kinds: Counter[str] = Counter()
        """How many different refusals of each sender there were."""
        self._untold: Counter[Refusal] = Counter()
        self._loop = asyncio.get_running_loop()
        self._throttle = Throttle(self._on_busy)
        self._timekeeping = Timekeeping(
            node,
            config.host,
            robot_time.setting(directory),
            corrects=not node.clock.needs_ticks,
        )
        self._begun = False
        """Whether this host's time has been compared, so that other processes may start."""

    async def run(self) -> None:
        tell_time(self._node, robot_time.clock(self._directory).now_ns)
        async with AsyncExitStack() as stack:
            watch = Watch(self._on_refusals, lambda line: log.warning("%s", line))
            stack.callback(watch.close)
            stack.callback(self._throttle.close)
            self._node.spawn(self._tell())
            self._node.spawn(self._hold_back())
            while True:
                marks, refused = self._marks(), self._timekeeping.refused
                site, options, self._admitted = self._read()
                self._timekeeping.follow(site.keeper(self._host), self._clock_limit_s(site))
                self._hosts = frozenset(site.hosts)
                router = await Router.open(
                    "gateway", self._directory, site.host(self._host).listen, site.endpoints(self._host), options
                )
                try:
                    self._links = {}
                    router.watch(self._on_link)
                    for link in router.links():  # that came before
                        self._on_link(link, True)
                    await self._begin()
                    self._report()
                    await self._until_changed(marks, refused)
                finally:
                    await router.close()
                    self._throttle.follow(())  # lest its duplicates keep connections open
                log.info("the site or the trust in this host's clock has changed: the router is opened anew")

    async def _begin(self) -> None:
        if not self._begun:
            await self._timekeeping.begin()
            self._begun = True
            self._node.spawn(self._timekeeping.run())

    def _read(self) -> tuple[Site, dict[str, Any], frozenset[str]]:
        """The plan, the router's options, and the common names that are admitted. Raises ConfigError."""
        site = plan.read(self._folder)
        now = datetime.now(UTC)
        known = admitted.read(site.folder)
        mine = credentials.read(
            site.folder / place.CREDENTIALS / self._host,
            now,
            name=self._host,
            role=site.role(self._host),
            authority=known.authority,
        )
        names = {name: known.common_names(name, now) for name in known.names}
        every = frozenset(common for name in site.principals for common in names.get(name, ()))
        only = of_clocks(site, site.host(self._host).robot) if self._timekeeping.refused else None
        return site, {**mine.options, **compiled(site, self._host, names, only=only)}, every

    def _clock_limit_s(self, site: Site) -> float:
        if self._config.clock_limit_ms is not None:
            return self._config.clock_limit_ms / 1e3
        measures = any({*MEASURED} & {*one.all_publishes()} for one in site.share(self._host))
        return (MEASURES_MS if measures else ELSE_MS) / 1e3

    def _marks(self) -> tuple[object, ...]:
        """What differs when a file of the site differs."""
        mine = self._folder / place.CREDENTIALS / self._host
        files = (self._folder / place.PLAN, self._folder / place.ADMITTED, mine / place.CERT)
        found: list[object] = []
        for file in files:
            try:
                status = file.stat()
                found.append((status.st_mtime_ns, status.st_ino, status.st_size))
            except OSError:
                found.append(None)
        return tuple(found)

    async def _until_changed(self, marks: tuple[object, ...], refused: bool) -> None:
        """Returns when the site's files have changed and can be read, or the trust in this host's clock has changed; a
        bad file changes nothing."""
        told = ""
        while self._timekeeping.refused == refused:
            await asyncio.sleep(LOOK_S)
            if refused:
                self._report()
            if self._marks() != marks:
                try:
                    self._read()
                except CocoroError as error:  # files that are only half copied are read again
                    self._node.degraded(f"the site has changed, but not for the better; the former stays: {error}")
                    if str(error) != told:
                        told = str(error)
                        log.error("%s; the former rules stay", error)
                else:
                    return

    # --- what it says ---------------------------------------------------------------------------------

    def _on_link(self, link: Link, there: bool) -> None:
        if there and self._links.get(link.zid) == link:
            return
        if there:
            self._links[link.zid] = link
        else:
            self._links.pop(link.zid, None)
        self._throttle.follow(one for one in self._links.values() if one.who.rpartition(".")[0] not in self._hosts)
        log.info("%s %s at %s", "linked with" if there else "lost the link with", link.who or "somebody", link.address)
        odd = self._odd_links()
        for fault in odd:
            if fault not in self._odd:
                log.warning("%s", fault)
        self._odd = odd
        self._report()

    def _report(self) -> None:
        if not self._begun:
            return
        linked = sorted({link.who.rpartition(".")[0] or link.who for link in self._links.values()})
        text = f"linked with {', '.join(linked)}" if linked else "no link to another host"
        if trouble := self._timekeeping.trouble:
            self._node.degraded(f"{trouble}; {text}")
        else:
            self._node.ready(text)
        self._show_faults()

    def _on_refusals(self, refused: Counter[Refusal]) -> None:
        """Called in the thread that reads the log."""
        self._loop.call_soon_threadsafe(self._count, refused)

    def _count(self, refused: Counter[Refusal]) -> None:
        for refusal, times in refused.items():
            if refusal.who in self._links:
                refusal = refusal._replace(who=self._links[refusal.who].who)
            if refusal not in self._refused and self._kinds[refusal.who] >= KINDS:
                refusal = Refusal(refusal.who, "more of other kinds")
            if refusal not in self._refused:
                self._kinds[refusal.who] += 1
                log.warning("refused: %s", _said(refusal))
                self._untold[refusal] -= 1
            self._untold[refusal] += times
            self._refused[refusal] += times
        self._show_faults()

    def _show_faults(self) -> None:
        self._node.faults = (
            *self._odd_links(),
            *(
                f"refused {_said(one)}{f', {count} times' if count > 1 else ''}"
                for one, count in self._refused.most_common(SHOWN)
            ),
        )

    def _on_busy(self, link: Link) -> None:
        self._count(Counter({Refusal(link.who, TOO_MUCH): 1}))

    async def _hold_back(self) -> None:
        while True:
            await asyncio.sleep(PERIOD_S)
            self._throttle.look(time.monotonic())

    def _odd_links(self) -> list[str]:
        """Faults of who is linked. What somebody tries who is not admitted is refused, and zenoh does not tell of it; a
        host is at one place."""
        found = []
        places: dict[str, set[str]] = {}
        for link in self._links.values():
            name = link.who.rpartition(".")[0]
            if link.who not in self._admitted:
                found.append(
                    f"{link.who or 'somebody'} is linked from {_place(link)}, not admitted, and may do nothing"
                )
            elif name in self._hosts:
                places.setdefault(name, set()).add(_place(link))
        found += [
            f"{host} is linked from {' and '.join(sorted(at))}: is its certificate stolen?"
            for host, at in places.items()
            if len(at) > 1
        ]
        return list(dict.fromkeys(found))

    async def _tell(self) -> None:
        while True:
            await asyncio.sleep(TELL_S)
            untold, self._untold = self._untold, Counter()
            for refusal, count in (+untold).items():
                log.warning("refused %d times more: %s", count, _said(refusal))


def _place(link: Link) -> str:
    """The address of a link's other end, without the port."""
    return link.address.partition("/")[2].rpartition(":")[0]


def _said(refusal: Refusal) -> str:
    if not refusal.who:
        return f"somebody who was not let in: {refusal.what}"
    return f"{refusal.who}: {refusal.what}{f' on {refusal.key}' if refusal.key else ''}"


async def run(node: Node, config: Config) -> None:
    """Keeps the links for ever. Raises ConfigError for a site, host or credentials that cannot be used."""
    if not config.site or not config.host:
        raise ConfigError("the gateway needs a site and a host: start it with `cocoro up --site DIR --host NAME`")
    await Gateway(node, config, RunDir(node.robot_name).path).run()


implementation = Implementation(Config, run)
