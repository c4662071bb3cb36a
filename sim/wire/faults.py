"""What can happen to bytes on their way: lost, corrupted, truncated, late, said twice, all gone. Seeded."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Literal

Kind = Literal["lost", "corrupted", "truncated", "late", "repeated", "silent"]
Way = Literal["to_device", "to_driver", "both"]
KINDS: tuple[Kind, ...] = ("lost", "corrupted", "truncated", "late", "repeated", "silent")


@dataclass(frozen=True)
class Fault:
    """A share of the bytes (lost, corrupted) or of the bursts (the others) suffers it, until a time."""

    kind: Kind
    share: float
    way: Way
    until_ns: int
    delay_ns: int = 30_000_000
    """For late ones."""


class Disturbance:
    """One direction of one line."""

    def __init__(self, way: Way, seed: int) -> None:
        self._way = way
        self._draws = Random(f"{way} {seed}")
        self._faults: list[Fault] = []
        self._late: list[tuple[int, bytes]] = []

    def add(self, fault: Fault) -> None:
        if fault.way in (self._way, "both"):
            self._faults.append(fault)

    def clear(self) -> None:
        self._faults.clear()

    def carry(self, data: bytes, now_ns: int) -> bytes:
        """What arrives now, of what is sent now and of what was held up. In order: nothing overtakes."""
        self._faults = [fault for fault in self._faults if fault.until_ns > now_ns]
        due_ns = now_ns
        for fault in self._faults if data else ():
            hit = self._draws.random() < fault.share
            if fault.kind == "late" and hit:
                due_ns = now_ns + fault.delay_ns
            else:
                data = self._suffer(fault, data, hit)
        if data:
            self._late.append((max(due_ns, self._late[-1][0] if self._late else 0), data))
        arrived = b""
        while self._late and self._late[0][0] <= now_ns:
            arrived += self._late.pop(0)[1]
        return arrived

    def _suffer(self, fault: Fault, data: bytes, hit: bool) -> bytes:
        draws = self._draws
        if fault.kind == "lost":
            return bytes(byte for byte in data if draws.random() >= fault.share)
        if fault.kind == "corrupted":
            return bytes(byte ^ draws.randrange(1, 256) if draws.random() < fault.share else byte for byte in data)
        if fault.kind == "silent":
            return b""
        if fault.kind == "truncated" and hit:
            return data[: draws.randrange(len(data))]
        if fault.kind == "repeated" and hit:
            return data + data
        return data
