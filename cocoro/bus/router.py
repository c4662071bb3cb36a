"""Joins the mesh of this machine with other machines: a zenoh session in router mode.

It is a member of the directory as every process is, and has links to other hosts.

Each process of this machine stays connected with each other directly, so the robot goes on without its router.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.register import Membership
from cocoro.bus.session import (
    LEAVE_S,
    PACKETS,
    SMALL_PRIORITIES,
    close_session,
    exit_guard,
    in_thread,
    open_session,
    options,
)
from cocoro.bus.zenoh import MEMBER

LEASE_S = 1.5
"""Time of silence after which a link to another host counts as lost. A link whose peer has gone without a word can only
be made again when it has been given up."""
OPENING_MS = 2000
"""Longest wait for one attempt to connect: TCP itself waits longer and longer for an answer that was lost."""
RETRY_MS = (50, 500)
"""First and longest pause between two attempts to connect."""
STALLED_US = 25_000
"""Longest wait of a large sample for a link that does not take it; then it is dropped, and commands go on."""


class Link(NamedTuple):
    """A link to another host or a client."""

    zid: str
    who: str
    """The common name of the certificate at its other end; '' for none."""
    address: str


class Router:
    """Make it with `await Router.open(...)`, and close it."""

    def __init__(self, session: zenoh.Session, membership: Membership) -> None:
        self._session = session
        self._membership = membership
        self._listeners: list[Any] = []
        self._left = False
        token = f"{MEMBER}/{membership.member.identity}"
        self._token = session.liveliness().declare_token(token)
        exit_guard.add(self._leave)

    @classmethod
    async def open(
        cls, name: str, directory: Path, listen: Sequence[str], connect: Sequence[str], more: Mapping[str, Any]
    ) -> Router:
        """Joins the mesh in `directory`, accepts others at `listen`, and keeps trying to connect to `connect`. `more`
        are zenoh's options for certificates and rules, by path. Raises ConfigError, MeshError, FullError."""
        membership = Membership.register(directory, name)
        try:
            here = [*membership.listen, *listen]
            config = ZenohConfig(name, mode="router", listen=tuple(here), lease_s=LEASE_S)
            chosen = options(config, membership.member.identity, here, [*membership.connect, *connect])
            chosen |= {
                "connect/timeout_ms": -1,
                "connect/exit_on_failure": False,
                "connect/retry": {
                    "period_init_ms": RETRY_MS[0],
                    "period_max_ms": RETRY_MS[1],
                    "period_increase_factor": 2,
                },
                "transport/unicast/open_timeout": OPENING_MS,
                # Of frames, too: each reader has one on the way, which the loss of a packet must not cost.
                "transport/link/tx/queue/size": dict.fromkeys((*SMALL_PRIORITIES, "background"), PACKETS),
                "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": STALLED_US,
                **more,
            }
            opened = await in_thread(lambda: open_session(config, chosen), undo=lambda it: it.close())
        except BaseException:
            membership.leave()
            raise
        return cls(opened.session, membership)

    def links(self) -> list[Link]:
        """The present links to other hosts and clients."""
        found = (_link(link) for link in self._session.info.links())
        return [link for link in found if not link.address.startswith("unixsock")]

    def watch(self, handler: Callable[[Link, bool], None]) -> None:
        """Calls `handler(link, there)` in the event loop for each link that begins or ends."""
        loop = asyncio.get_running_loop()

        def on_event(event: zenoh.LinkEvent) -> None:
            link = _link(event.link)
            if not link.address.startswith("unixsock"):
                loop.call_soon_threadsafe(handler, link, event.kind == zenoh.SampleKind.PUT)

        self._listeners.append(self._session.info.declare_link_events_listener(on_event))

    async def close(self) -> None:
        """Leaves the mesh; takes at most `LEAVE_S`."""
        try:
            async with asyncio.timeout(LEAVE_S):
                await in_thread(self._leave)
        except TimeoutError:
            pass

    def _leave(self) -> None:
        if self._left:
            return
        self._left = True
        exit_guard.discard(self._leave)
        self._membership.leave()
        close_session(self._session)


def _link(link: zenoh.Link) -> Link:
    return Link(str(link.zid), link.auth_identifier or "", str(link.dst))
