"""One direction of an emulated network: delay, jitter, loss, rate and cuts, in virtual time."""

from __future__ import annotations

from math import inf
from statistics import fmean, pstdev
from typing import Any

import pytest

from sim.network.direction import Counts, Direction, Settings

MS = 1_000_000
PACKET = bytes(1000)


def direction_of(seed: str = "seed", **settings: Any) -> Direction:
    direction = Direction(seed)
    direction.change(Settings(**settings), 0)
    return direction


def numbered(number: int) -> bytes:
    return number.to_bytes(4, "big")


def arrivals(direction: Direction) -> list[tuple[float, bytes]]:
    """Let time pass until the direction is empty: when each packet is delivered."""
    found: list[tuple[float, bytes]] = []
    while (now_ns := direction.next_ns) != inf:
        found += [(now_ns / MS, packet) for packet in direction.take(now_ns)]
    return found


def test_a_direction_without_settings_delivers_at_once() -> None:
    direction = direction_of()
    assert direction.put(PACKET, 5)
    assert direction.next_ns == inf
    assert direction.counts == Counts(delivered=1)


def test_a_packet_arrives_after_the_delay_and_no_sooner() -> None:
    direction = direction_of(delay_ms=20)
    assert not direction.put(PACKET, 3 * MS)
    assert direction.take(23 * MS - 1) == []
    assert direction.counts == Counts(underway=1)
    assert arrivals(direction) == [(23.0, PACKET)]


@pytest.mark.parametrize("distribution", ["uniform", "normal"])
def test_jitter_spreads_delays_as_asked_and_keeps_the_order(distribution: str) -> None:
    direction = direction_of(delay_ms=20, jitter_ms=6, distribution=distribution)
    spans = []
    for number in range(2000):
        direction.put(numbered(number), number * 100 * MS)
        [(came_ms, packet)] = arrivals(direction)
        assert packet == numbered(number)
        spans.append(came_ms - number * 100)
    assert abs(fmean(spans) - 20) < 0.5
    assert abs(pstdev(spans) - (6 / 3**0.5 if distribution == "uniform" else 6)) < 0.3
    if distribution == "uniform":
        assert min(spans) >= 14
        assert max(spans) <= 26
    for number in range(1000):  # all at once
        direction.put(numbered(number), 0)
    assert [packet for _, packet in arrivals(direction)] == [numbered(number) for number in range(1000)]


def test_packets_overtake_one_another_only_when_asked() -> None:
    direction = direction_of(delay_ms=20, jitter_ms=10, reorder=True)
    packets = [numbered(number) for number in range(100)]
    for number, packet in enumerate(packets):
        direction.put(packet, number * MS)
    came = [packet for _, packet in arrivals(direction)]
    assert came != packets
    assert sorted(came) == packets


def test_loss_has_its_probability_and_is_the_same_for_a_seed() -> None:
    def passed(seed: str, **settings: Any) -> list[bytes]:
        direction = direction_of(seed, loss=0.01, **settings)
        return [numbered(n) for n in range(10_000) if direction.put(numbered(n), n) or direction.take(n + 1e12)]

    first = passed("a")
    assert 9850 < len(first) < 9950
    assert first == passed("a")
    assert first == passed("a", delay_ms=5, jitter_ms=3), "jitter draws its own numbers"
    assert first != passed("b")


def test_a_rate_sends_packets_one_after_another() -> None:
    direction = direction_of(delay_ms=5, rate_bps=8e6)  # 1000 bytes take 1 ms
    for _ in range(3):
        direction.put(PACKET, 0)
    assert [when for when, _ in arrivals(direction)] == [6.0, 7.0, 8.0]


def test_the_queue_of_a_rate_drops_what_finds_no_room() -> None:
    direction = direction_of(rate_bps=8e6, queue_bytes=10_000)
    for number in range(100):
        direction.put(number.to_bytes(4, "big") + bytes(996), 0)
    assert direction.counts == Counts(overflowed=90, underway=10)
    assert [int.from_bytes(packet[:4], "big") for _, packet in arrivals(direction)] == [*range(10)]
    assert not direction.put(bytes(20_000), 1e9), "one packet always finds room"
    assert direction.counts.overflowed == 90


def test_a_higher_rate_holds_for_what_waits() -> None:
    direction = direction_of(rate_bps=8.0)  # 1000 s for each packet
    direction.put(numbered(1) + bytes(996), 0)
    direction.put(numbered(2) + bytes(996), 0)
    direction.change(Settings(rate_bps=8e6), 10 * MS)
    assert [when for when, _ in arrivals(direction)] == [11.0, 12.0]
    direction.change(Settings(rate_bps=8.0), 0)
    direction.put(PACKET, 20 * MS)
    direction.put(PACKET, 20 * MS)
    direction.change(Settings(), 30 * MS)
    assert [when for when, _ in arrivals(direction)] == [30.0, 30.0]


def test_a_shorter_delay_holds_for_what_is_under_direction_and_keeps_the_order() -> None:
    direction = direction_of(delay_ms=10_000)
    direction.put(numbered(1), 0)
    direction.put(numbered(2), MS)
    direction.change(Settings(delay_ms=5), 10 * MS)
    direction.put(numbered(3), 10 * MS)
    assert arrivals(direction) == [(15.0, numbered(1)), (15.0, numbered(2)), (15.0, numbered(3))]


@pytest.mark.parametrize("settings", [{}, {"delay_ms": 5}, {"rate_bps": 8e6}])
def test_a_cut_loses_what_is_sent_and_what_is_under_way(settings: dict[str, Any]) -> None:
    direction = direction_of(**settings)
    direction.change(Settings(delay_ms=5, rate_bps=settings.get("rate_bps")), 0)
    for _ in range(3):
        direction.put(PACKET, 0)
    direction.change(Settings(**settings), 0)
    direction.cut(until_ns=100 * MS)
    assert direction.next_ns == inf
    assert not direction.put(PACKET, 99 * MS)
    assert arrivals(direction) == []
    assert direction.counts == Counts(cut=4)
    assert direction.put(PACKET, 100 * MS) or len(arrivals(direction)) == 1, "the cut has ended"
    direction.cut(inf)
    direction.put(PACKET, 1e15)
    direction.heal()
    assert direction.put(PACKET, 1e15) or len(arrivals(direction)) == 1
    assert direction.counts == Counts(delivered=2, cut=5)
    assert direction.counts.sent == 7


@pytest.mark.parametrize(
    "settings",
    [
        {"delay_ms": -1},
        {"jitter_ms": inf},
        {"delay_ms": float("nan")},
        {"loss": 1.5},
        {"rate_bps": 0},
        {"queue_bytes": 0},
        {"distribution": "pareto"},
    ],
)
def test_settings_that_no_direction_can_have_are_refused_by_name(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        Settings(**settings)
