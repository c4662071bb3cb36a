"""Network links between the robot's body and its brain, in virtual time: one that can be cut, and one that is slow and
loses packets."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable

from cocoro.bus.base import Handle, OnAlive, OnSample, Payload, Qos
from cocoro.bus.local import LocalMesh, LocalSubscription
from cocoro.bus.router import LEASE_S
from cocoro.testing import NotedBus
from cocoro.topics import FRAME

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


class SlowLink:
    """A link as TCP makes it: nothing is lost, but what was sent after a lost packet waits until that was sent again.

    Messages of one millisecond travel in one packet. A frame is asked for when the last has arrived, as by the
    unpacker. Requests are not delayed. Pass `bus` to a `RobotRig` as `bus_of`.
    """

    FRAME_PACKETS = 10
    """Of a packed frame of 320 x 240."""
    AGAIN_S = 0.02
    """From a loss's notice, a round trip after the packet was sent, until it is sent again."""

    def __init__(self, delay_s: float, loss: float, seed: int = 0) -> None:
        """`delay_s`: of each way; `loss`: share of the packets that are lost."""
        self.delay_s = delay_s
        self._loss = loss
        self._random = random.Random(f"link/{seed}")
        self._packet_ms = {"body": -1, "brain": -1}
        self._due_s = {"body": 0.0, "brain": 0.0}
        """By the side that it comes from, when the newest packet arrives."""
        self._asked_s = 0.0
        """When the next frame's request arrives."""

    def bus(self, mesh: LocalMesh, robot: str, name: str) -> NotedBus:
        return _SlowBus(mesh, robot, side_of(name), self)

    def carry(self, key: str, side: str, hand_over: Callable[[], None]) -> None:
        """Hand a message over to the other side when it arrives; a frame that nobody asked for yet is dropped."""
        loop = asyncio.get_running_loop()
        is_frame = key.endswith(FRAME.name)
        if is_frame and loop.time() < self._asked_s:
            return
        if is_frame or round(loop.time() * 1e3) != self._packet_ms[side]:
            self._packet_ms[side] = -1 if is_frame else round(loop.time() * 1e3)
            self._due_s[side] = max(self._due_s[side], loop.time() + self._way_s(self.FRAME_PACKETS if is_frame else 1))
        if is_frame:
            self._asked_s = self._due_s[side] + self._way_s(1)
        loop.call_at(self._due_s[side], hand_over)

    def _way_s(self, packets: int) -> float:
        """The time until the last of some packets that are sent now has arrived."""
        longest_s = 0.0
        for _ in range(packets):
            way_s = self.delay_s
            while self._random.random() < self._loss:
                way_s += 2 * self.delay_s + self.AGAIN_S
            longest_s = max(longest_s, way_s)
        return longest_s


class _SlowBus(NotedBus):
    def __init__(self, mesh: LocalMesh, robot: str, side: str, link: SlowLink) -> None:
        super().__init__(mesh, robot)
        self._side, self._link = side, link

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> LocalSubscription:
        def hear(key: str, payload: Payload) -> None:
            if beyond(self._side, key):
                kept = bytes(payload)
                self._link.carry(key, side_of(key.split("/")[1]), lambda: handler(key, kept))
            else:
                handler(key, payload)

        return super().subscribe(keyexpr, qos, hear, depth=depth)


def side_of(name: str) -> str:
    return "brain" if name in BRAIN else "body"


def beyond(side: str, key: str) -> bool:
    """Whether what a key stands for is on the other side: a message of that service, or its token."""
    return side_of(key.split("/")[1]) != side
