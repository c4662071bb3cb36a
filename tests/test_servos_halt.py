"""A servo line that the emergency stop's path halts while the event loop hangs."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from types import TracebackType

from services.servos.bus import SilentError
from services.servos.cycle import CycleResult
from services.servos.dynamixel import DYNAMIXEL
from services.servos.family import ServoReading
from services.servos.line import ServoLine
from services.servos.motion import HOLD_RADPS
from services.servos.orders import GroupOrders
from services.servos.watch import ServoStatus, ServoTask

PATIENCE_S = 60.0
FAR = {5: (900, 30)}
HOLD = round(HOLD_RADPS / DYNAMIXEL.units.speed_radps)


class Wire:
    """Replaces the bus: an elbow that moves by one count each time it is read."""

    strays = 0

    def __init__(self) -> None:
        self.written: list[dict[int, tuple[int, int]]] = []
        self.position = 512
        self.misses = 0
        """How many of the next readings get no answer."""
        self._news = threading.Condition()

    def __enter__(self) -> Wire:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def go(self, orders: Mapping[int, tuple[int, int]]) -> None:
        with self._news:
            self.written.append(dict(orders))
            self._news.notify_all()

    def reading(self, number: int) -> ServoReading:
        if self.misses:
            self.misses -= 1
            raise SilentError(number)
        self.position += 1
        return ServoReading(0, self.position, 0, 0, 12, 38, 0)

    def read_block(self, _number: int, _first: int, _length: int) -> tuple[bytes, int]:
        return b"", 0

    def until(self, good: Callable[[list[dict[int, tuple[int, int]]]], object]) -> None:
        with self._news:
            assert self._news.wait_for(lambda: good(self.written), PATIENCE_S)


def scenario(keeps_goal: bool, test: Callable[[GroupOrders, Wire], None], *groups: GroupOrders) -> None:
    """Run a test in the event loop's thread, so that the loop is blocked meanwhile. The line carries these groups; by
    default one, which the test gets."""

    async def run() -> None:
        wire = Wire()
        orders = GroupOrders(keeps_goal=keeps_goal)
        settings = {5: {"torque_limit": 1023}}
        line = ServoLine("nowhere", 1, DYNAMIXEL, settings, 200.0, 0.1, lambda _: None, groups or [orders])
        line._open = lambda: wire  # type: ignore[assignment, return-value]
        line.start()
        try:
            test(orders, wire)
        finally:
            await line.stop()

    asyncio.run(run())


def test_what_is_under_orders_holds_where_it_was_just_read_and_stays_there() -> None:
    def test(orders: GroupOrders, wire: Wire) -> None:
        orders.give(FAR)
        wire.until(lambda written: FAR in written)
        orders.halt()
        wire.until(lambda written: written[-1] != FAR)
        held = wire.written[-1]
        assert held[5][0] <= wire.position
        assert held[5][1] == HOLD
        orders.give({5: (1000, 30)})  # of a loop that hung, and does not know yet
        count = len(wire.written)
        wire.until(lambda written: len(written) > count + 5)
        assert wire.written[count + 1 :] == [held] * len(wire.written[count + 1 :])

    scenario(False, test)


def test_who_knows_of_the_stop_gives_the_orders_again() -> None:
    def test(orders: GroupOrders, wire: Wire) -> None:
        orders.give(FAR)
        orders.halt()
        wire.until(lambda written: written and written[-1] != FAR)
        orders.give({5: (600, HOLD)})
        orders.go_on()
        wire.until(lambda written: written[-1] == {5: (600, HOLD)})

    scenario(False, test)


def test_a_hand_goes_on_holding_what_it_holds_and_takes_no_new_goals() -> None:
    def test(orders: GroupOrders, wire: Wire) -> None:
        orders.give(FAR)
        wire.until(lambda written: FAR in written)
        orders.halt()
        orders.give({5: (100, 30)})
        wire.until(lambda written: {} in written)
        count = len(wire.written)
        wire.until(lambda written: len(written) > count + 5)
        assert {5: (100, 30)} not in wire.written

    scenario(True, test)


def test_what_does_not_answer_just_then_holds_as_soon_as_it_does() -> None:
    def test(orders: GroupOrders, wire: Wire) -> None:
        orders.give(FAR)
        wire.until(lambda written: FAR in written)
        wire.misses = 2
        orders.halt()
        wire.until(lambda written: 5 in written[-1] and written[-1] != FAR)
        assert wire.misses == 0

    scenario(False, test)


def test_one_group_of_a_line_is_halted_while_the_other_goes_on() -> None:
    arm, hand = GroupOrders(), GroupOrders(keeps_goal=True)

    def test(_: GroupOrders, wire: Wire) -> None:
        arm.give(FAR)
        hand.give({7: (300, 20)})
        wire.until(lambda written: {**FAR, 7: (300, 20)} in written)
        arm.halt()
        wire.until(lambda written: written[-1].get(5, FAR[5]) != FAR[5])
        hand.give({7: (350, 20)})
        wire.until(lambda written: written[-1].get(7) == (350, 20))
        assert wire.written[-1][5][1] == HOLD
        hand.halt()
        count = len(wire.written)
        wire.until(lambda written: len(written) > count + 5)
        assert [*wire.written[-1]] == [5]

    scenario(False, test, arm, hand)


def test_of_a_cycles_results_each_group_gets_those_of_its_servos() -> None:
    read = {number: ServoReading(0, 512, 0, 0, 12, 38, 0) for number in (5, 7)}
    status, task, other = ServoStatus(True, 1, 1, 0), ServoTask("enable", 5), ServoTask("enable", 7)
    whole = CycleResult(
        read, [5, 7], {5: status, 7: status}, {5: True, 7: False}, [(task, 1), (other, 2)], [task, other],
        [(task, "no"), (other, "no")], "broken", 0.01, 3,
    )  # fmt: skip
    mine = CycleResult(
        {7: read[7]}, [7], {7: status}, {7: False}, [(other, 2)], [other], [(other, "no")], "broken", 0.01, 3
    )
    assert whole.of({7}) == mine
    assert whole.of({5, 7}) == whole
