"""The wheels stop when the service dies, whatever garbled bytes did to the Create before, once the line is good again.
The guard's logic and the emulated firmware run against each other in virtual time."""

from __future__ import annotations

from random import Random

import pytest

from services.base.guard_logic import MS, GuardLogic
from sim.wire.create import EmulatedCreate
from sim.wire.emulator import SimplePlant
from sim.wire.line import Disturbance, FaultKind, LineFault

BAUD = 57600
TURN_NS = 5 * MS
BYTES_A_TURN = BAUD // 10 * TURN_NS // (1000 * MS)
DEADMAN_NS = 200 * MS
STOP_NS = 300 * MS
AGAIN_NS = 20_000 * MS
SPEEDS = ((200, 200), (120, -120), (250, 110), (-80, -80))


class Line:
    """The guard's logic and a Create, with a wire between them that has a delay and can be disturbed."""

    def __init__(self, seed: int) -> None:
        self.draws = Random(seed)
        self.create = EmulatedCreate()
        self.logic = GuardLogic("safe", DEADMAN_NS)
        self.now_ns = 10**12
        self.disturbed = Disturbance("to_device", seed)
        self.wanted: tuple[int, int] | None = SPEEDS[0]
        self._body = SimplePlant(self.create)
        self._sent = b""
        self.logic.opened(self.now_ns)

    def turn(self) -> None:
        self.now_ns += TURN_NS
        if self.wanted is not None:
            self.logic.ask(*self.wanted, self.now_ns + DEADMAN_NS, self.now_ns)
            if self.logic.link == "fallen":
                self.logic.recover(self.now_ns)
        self._sent += self.disturbed.carry(self.logic.poll(self.now_ns), self.now_ns)
        now, self._sent = self._sent[:BYTES_A_TURN], self._sent[BYTES_A_TURN:]
        self._body.advance(self.now_ns)
        self.create.receive(now, BAUD, self.now_ns)
        self.logic.receive(self.create.advance(BAUD, self.now_ns), self.now_ns)

    def drives(self) -> bool:
        """Wait until the wheels turn as asked; False when the Create is deaf or has another baud rate."""
        end_ns = self.now_ns + AGAIN_NS
        while self.now_ns < end_ns:
            self.turn()
            if self.lost_to_the_world:
                return False
            if self.logic.wheels[:2] == self.create.wheels_mmps != (0, 0):
                return True
        raise AssertionError(f"stuck: {self.logic.link}, mode {self.create.mode}, pending {self.create.pending.hex()}")

    @property
    def lost_to_the_world(self) -> bool:
        """Whether a garbled byte has made the Create wait for an event or change its baud rate."""
        return self.create.deaf or self.create.baud != BAUD

    def garble(self, kind: FaultKind, share: float, for_ns: int) -> None:
        self.disturbed.add(LineFault(kind, share, "to_device", self.now_ns + for_ns))
        end_ns = self.now_ns + for_ns
        while self.now_ns < end_ns:
            self.wanted = self.draws.choice(SPEEDS) if self.draws.random() < 0.05 else self.wanted
            self.turn()
        self.disturbed.clear()

    def stops_after_ns(self) -> int:
        """Advance from the death of the service on."""
        self.wanted = None
        self.logic.end(self.now_ns)
        began_ns = self.now_ns
        while self.create.wheels_mmps != (0, 0):
            self.turn()
            if self.now_ns - began_ns > AGAIN_NS:
                break
        return self.now_ns - began_ns


def one(seed: int, kind: FaultKind) -> int | None:
    """The time, ns, for which the wheels turned after the service died; None when nothing could have stopped them."""
    line = Line(seed)
    assert line.drives()
    line.garble(kind, line.draws.uniform(0.003, 0.1), round(line.draws.uniform(100, 1500)) * MS)
    # The service dies at any moment, after the Create has recovered or before.
    if line.draws.random() < 0.5 and not line.drives():
        return None
    for _ in range(line.draws.randrange(20)):
        line.turn()
    if line.lost_to_the_world:
        return None
    took_ns = line.stops_after_ns()
    return None if line.lost_to_the_world else took_ns


@pytest.mark.parametrize("kind", ["corrupted", "lost", "truncated", "repeated"])
def test_the_wheels_stop_in_time_unless_a_garbled_byte_has_made_the_create_deaf(kind: FaultKind) -> None:
    took = [one(seed, kind) for seed in range(60)]
    heard = [each for each in took if each is not None]
    assert len(heard) > 40
    assert max(heard) < STOP_NS
