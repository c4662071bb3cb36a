"""A network link between the robot's body and its brain, in virtual time, that can be cut."""

from __future__ import annotations

import asyncio

from cocoro.bus.base import Handle, OnAlive, OnSample, Payload, Qos
from cocoro.bus.local import LocalMesh, LocalSubscription
from cocoro.bus.router import LEASE_S
from cocoro.testing import NotedBus

BRAIN = ("perception", "planning", "executive")
AGAIN_S = 0.3
"""Time from the repair of the link until both sides know each other again."""


class Link:
    """Everything but `BRAIN` is on the body's side, operators too. Pass `bus` to a `RobotRig` as `bus_of`."""

    def __init__(self) -> None:
        self.is_cut = False
        self._watches: list[tuple[str, OnAlive]] = []
        self._tokens: dict[str, set[str]] = {"body": set(), "brain": set()}

    def bus(self, mesh: LocalMesh, robot: str, name: str) -> NotedBus:
        return _LinkedBus(mesh, robot, side_of(name), self)

    def watch(self, side: str, handler: OnAlive) -> OnAlive:
        """A handler of tokens on one side of the link."""

        def tell(key: str, alive: bool) -> None:
            (self._tokens[side].add if alive else self._tokens[side].discard)(key)
            if not (self.is_cut and beyond(side, key)):
                handler(key, alive)

        self._watches.append((side, handler))
        return tell

    async def cut(self, for_s: float) -> None:
        """Let no message through for a time; returns when both sides know each other again."""
        self.is_cut = True
        if for_s > LEASE_S:
            await asyncio.sleep(LEASE_S)
            self._tell(alive=False)
            await asyncio.sleep(for_s - LEASE_S + AGAIN_S)
            self.is_cut = False
            self._tell(alive=True)
        else:
            await asyncio.sleep(for_s)
            self.is_cut = False

    def _tell(self, *, alive: bool) -> None:
        for side, handler in self._watches:
            for key in sorted(self._tokens[side]):
                if beyond(side, key):
                    handler(key, alive)


class _LinkedBus(NotedBus):
    def __init__(self, mesh: LocalMesh, robot: str, side: str, link: Link) -> None:
        super().__init__(mesh, robot)
        self._side, self._link = side, link

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> LocalSubscription:
        def hear(key: str, payload: Payload) -> None:
            if not (self._link.is_cut and beyond(self._side, key)):
                handler(key, payload)

        return super().subscribe(keyexpr, qos, hear, depth=depth)

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> Handle:
        return super().watch_alive(keyexpr, self._link.watch(self._side, handler))


def side_of(name: str) -> str:
    return "brain" if name in BRAIN else "body"


def beyond(side: str, key: str) -> bool:
    """Whether what a key stands for is on the other side: a message of that service, or its token."""
    return side_of(key.split("/")[1]) != side
