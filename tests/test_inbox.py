"""Received messages are checked, counted and handed on."""

from __future__ import annotations

import asyncio
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inbox_rig import FAR, KEY, StillClock, inbox_of, payload
from message_samples import data_of

from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, FollowedClock
from cocoro.inbox import Inbox, Latest, Stream
from cocoro.stepper import Intake
from cocoro.testing import in_virtual_time
from cocoro.topics import TOPICS, Topic

MS = NS // 1000
every_topic = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)


# --- at the border --------------------------------------------------------------------------------


@every_topic
@settings(max_examples=30)
@given(garbage=st.binary(max_size=60))
def test_garbage_is_counted_and_dropped_and_raises_nothing(topic: Topic[Any], garbage: bytes) -> None:
    inbox, got = inbox_of(topic)
    inbox.deliver(KEY, garbage)
    try:
        msgspec.msgpack.decode(garbage, type=topic.type)
    except msgspec.MsgspecError:
        assert (inbox.rejected, inbox.rate.count, got) == (1, 0, [])
        assert inbox.last_error


@every_topic
@settings(max_examples=30)
@given(data=st.data())
def test_a_message_that_was_damaged_on_its_way_never_raises(topic: Topic[Any], data: st.DataObject) -> None:
    damaged = bytearray(msgpack.packb(data.draw(data_of(topic.type))))
    for place in data.draw(st.lists(st.integers(0, len(damaged) - 1), min_size=1, max_size=4)):
        damaged[place] = data.draw(st.integers(0, 255))
    inbox, got = inbox_of(topic)
    inbox.deliver(KEY, bytes(damaged))
    assert inbox.rejected + inbox.rate.count == 1
    assert len(got) == inbox.rate.count


@pytest.mark.parametrize(
    "claims", [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\x81" * 60_000]
)
def test_what_claims_to_be_huge_or_endless_is_dropped_at_once(claims: bytes) -> None:
    inbox, got = inbox_of(topics.BASE_STATE)
    inbox.deliver(KEY, claims)
    assert (inbox.rejected, got) == (1, [])


@every_topic
def test_what_is_larger_than_its_row_allows_is_dropped_unread(topic: Topic[Any]) -> None:
    inbox, got = inbox_of(topic)
    inbox.deliver(KEY, bytes(topic.max_bytes + 1))
    assert (inbox.rejected, got) == (1, [])
    assert f"at most {topic.max_bytes} are taken" in inbox.last_error


def test_after_any_number_of_bad_messages_good_ones_are_taken() -> None:
    inbox, got = inbox_of(topics.BASE_STATE)
    for _ in range(3):
        inbox.deliver(KEY, b"\xc1")
    inbox.deliver(KEY, payload(topics.BASE_STATE))
    assert (inbox.rejected, len(got)) == (3, 1)


# --- order ----------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 9), min_size=1, max_size=12))
def test_nothing_is_taken_twice_or_in_the_wrong_order(seqs: list[int]) -> None:
    inbox, got = inbox_of(topics.TASK)
    for seq in seqs:
        inbox.deliver(KEY, payload(topics.TASK, seq))
    taken = [message.seq for message in got]
    assert taken == sorted(set(taken))
    assert inbox.rejected == len(seqs) - len(taken)
    assert max(seqs) == taken[-1]


def test_gaps_in_the_sequence_are_losses() -> None:
    inbox, _ = inbox_of(topics.TASK)
    for seq in (4, 5, 8, 10):
        inbox.deliver(KEY, payload(topics.TASK, seq))
    assert inbox.health(0).lost == 3


def test_a_restarted_publisher_has_lost_nothing() -> None:
    inbox, got = inbox_of(topics.TASK)
    inbox.deliver(KEY, payload(topics.TASK, seq=70, incarnation=1))
    inbox.deliver(KEY, payload(topics.TASK, seq=0, incarnation=2))
    assert len(got) == 2
    assert inbox.health(0).lost == 0


def test_publishers_on_different_keys_count_for_themselves() -> None:
    inbox, got = inbox_of(topics.HEALTH.of("*"))
    for key in ("calliope/base/health", "calliope/arm/health"):
        inbox.deliver(key, payload(topics.HEALTH, seq=5, service="x"))
        inbox.deliver(key, payload(topics.HEALTH, seq=6, service="x"))
    assert (len(got), inbox.rejected) == (4, 0)


# --- age ------------------------------------------------------------------------------------------

EXPIRING = [topic for topic in TOPICS if topic.qos is Qos.COMMAND and topic is not topics.CLOCK]


def test_every_command_expires_in_time() -> None:
    assert {topic.name for topic in EXPIRING} >= {"base/command", "arm/command", "hand/command", "executive/intent"}
    assert all(topic.max_age_s <= 0.3 for topic in EXPIRING)


@pytest.mark.parametrize(
    ("age_s", "taken"), [(0.0, 1), (0.14, 1), (0.16, 0), (100.0, 0), (-0.2, 1), (-0.3, 0), (-1e6, 0)]
)
def test_a_command_acts_neither_after_its_time_nor_before_it(age_s: float, taken: int) -> None:
    inbox, got = inbox_of(topics.BASE_COMMAND)
    inbox.deliver(KEY, payload(topics.BASE_COMMAND, stamp_ns=100 * NS - round(age_s * NS)))
    assert (len(got), inbox.rejected) == (taken, 1 - taken)
    assert inbox.health(0).expired == (not taken and age_s > 0)


@pytest.mark.parametrize(
    ("topic", "ahead_s", "taken"),
    [
        (topics.BASE_STATE, 0.2, 1), (topics.BASE_STATE, 0.3, 0), (topics.BASE_STATE, FAR / NS, 0),
        (topics.LATCH, 1.0, 0), (topics.FRAME, 1.0, 0), (topics.TASK, 1.0, 1),
    ],
)  # fmt: skip
def test_states_from_the_future_are_rejected_and_nothing_after_them(
    topic: Topic[Any], ahead_s: float, taken: int
) -> None:
    pixels = {"width": 1, "height": 1, "colour": bytes(3), "depth": bytes(2)} if topic is topics.FRAME else {}
    fields = {"state": "released"} if topic is topics.LATCH else pixels
    clock = StillClock()
    inbox, got = inbox_of(topic, clock)
    for seq in range(20):
        clock.at_ns += NS // 10
        inbox.deliver(KEY, payload(topic, seq, stamp_ns=clock.at_ns, **fields))
    inbox.deliver(KEY, payload(topic, 20, stamp_ns=clock.at_ns + round(ahead_s * NS), **fields))
    assert (len(got), inbox.rejected) == (20 + taken, 1 - taken)
    inbox.deliver(KEY, payload(topic, 21, stamp_ns=clock.at_ns, **fields))
    assert got[-1].seq == 21
    assert inbox.health(0).lost == 0


def test_an_onlooker_whose_clock_is_wrong_sees_everything() -> None:
    both: tuple[Topic[Any], ...] = (topics.BASE_STATE, topics.BASE_COMMAND)
    for topic in both:
        inbox = Inbox(topic, KEY, StillClock(), onlooker=True)
        for seq, stamp_s in enumerate((1, 10_000)):
            inbox.deliver(KEY, payload(topic, seq, stamp_ns=stamp_s * NS))
        assert (inbox.rejected, inbox.rate.count) == (0, 2)


def test_before_a_followed_clock_has_started_nothing_is_from_the_future() -> None:
    clock = FollowedClock()
    inbox = Inbox(topics.BASE_STATE, KEY, clock)
    inbox.deliver(KEY, payload(topics.BASE_STATE, 0))
    clock.tick(NS, 1)
    inbox.deliver(KEY, payload(topics.BASE_STATE, 1))
    assert (inbox.rate.count, inbox.rejected) == (1, 1)


def test_after_a_clock_has_begun_anew_stamps_are_judged_by_the_new_time() -> None:
    clock = FollowedClock()
    inbox = Inbox(topics.BASE_STATE, KEY, clock)
    clock.tick(1000 * NS, 1)
    inbox.deliver(KEY, payload(topics.BASE_STATE, 0, stamp_ns=1000 * NS))
    clock.tick(NS, 2)
    inbox.health(NS)
    inbox.deliver(KEY, payload(topics.BASE_STATE, 1, stamp_ns=900 * NS))
    inbox.deliver(KEY, payload(topics.BASE_STATE, 2, stamp_ns=NS))
    assert (inbox.rate.count, inbox.rejected) == (2, 1)


def test_an_old_state_is_handed_on_for_its_reader_to_judge() -> None:
    inbox, got = inbox_of(topics.BASE_STATE)
    inbox.deliver(KEY, payload(topics.BASE_STATE, stamp_ns=1))
    assert len(got) == 1


def test_the_clock_is_not_judged_by_the_clock() -> None:
    inbox, got = inbox_of(topics.CLOCK)
    inbox.deliver(KEY, payload(topics.CLOCK, stamp_ns=1))
    assert len(got) == 1


# --- the newest -----------------------------------------------------------------------------------


def test_the_latest_is_fresh_for_as_long_as_its_row_says() -> None:
    clock = StillClock()
    inbox, _ = inbox_of(topics.BASE_STATE, clock)
    latest = Latest(inbox, clock)
    assert latest.value is None
    assert latest.fresh() is None
    inbox.deliver(KEY, payload(topics.BASE_STATE))
    clock.at_ns += 150 * MS
    assert latest.fresh() is not None
    clock.at_ns += 1
    assert latest.fresh() is None
    assert latest.fresh(max_age_s=1.0) is latest.value is not None


def test_what_was_heard_before_the_clock_began_anew_is_not_fresh() -> None:
    clock = StillClock(1000 * NS)
    inbox, _ = inbox_of(topics.BASE_STATE, clock)
    latest = Latest(inbox, clock)
    inbox.deliver(KEY, payload(topics.BASE_STATE, stamp_ns=1000 * NS))
    clock.at_ns = NS
    assert latest.fresh() is None


def test_states_that_a_newer_one_replaced_before_somebody_looked_are_no_loss() -> None:
    clock = StillClock()
    inbox, _ = inbox_of(topics.BASE_STATE, clock)
    latest = Latest(inbox, clock)
    for seq in range(5):
        inbox.deliver(KEY, payload(topics.BASE_STATE, seq))
    assert latest.value is not None
    assert latest.value.seq == 4
    inbox.deliver(KEY, payload(topics.BASE_STATE, 5))
    assert inbox.health(0).skipped == 0


@in_virtual_time
async def test_the_next_is_one_that_is_not_here_yet() -> None:
    clock = StillClock()
    inbox, _ = inbox_of(topics.BASE_STATE, clock)
    latest = Latest(inbox, clock)
    inbox.deliver(KEY, payload(topics.BASE_STATE, 0))
    waiting = [asyncio.create_task(latest.next()) for _ in range(2)]
    await asyncio.sleep(1.0)
    assert not any(task.done() for task in waiting)
    inbox.deliver(KEY, payload(topics.BASE_STATE, 1))
    assert [message.seq for message in await asyncio.gather(*waiting)] == [1, 1]


# --- every one ------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_stream_gives_everything_in_order_however_slow_its_reader() -> None:
    inbox, _ = inbox_of(topics.TASK)
    stream, seqs = Stream(inbox), []
    for seq in range(300):
        inbox.deliver(KEY, payload(topics.TASK, seq))
    async for message in stream:
        seqs.append(message.seq)
        if message.seq == 299:
            break
    assert seqs == list(range(300))
    assert stream.overflowed == 0


@in_virtual_time
async def test_a_stream_whose_reader_has_died_does_not_grow_for_ever() -> None:
    inbox, _ = inbox_of(topics.TASK)
    stream = Stream(inbox, limit=10)
    for seq in range(25):
        inbox.deliver(KEY, payload(topics.TASK, seq))
    assert stream.overflowed == 15
    assert (await stream.next()).seq == 15
    stream.close()
    inbox.deliver(KEY, payload(topics.TASK, 99))
    assert [(await stream.next()).seq for _ in range(9)] == list(range(16, 25))


# --- for a core -----------------------------------------------------------------------------------


class Gathered:
    """An intake of commands ('latest') and tasks ('all')."""

    def __init__(self, limit: int = 4096) -> None:
        self.intake = Intake(limit)
        self.woken = 0
        self.inboxes: dict[str, Inbox[Any]] = {}
        for topic, take_all in ((topics.INTENT, False), (topics.TASK, True)):
            inbox, _ = inbox_of(topic)
            inbox.add(self.intake.reader(topic, inbox, take_all, self.wake if take_all else None))
            self.inboxes[topic.name] = inbox

    def wake(self) -> None:
        self.woken += 1

    def give(self, topic: Topic[Any], seq: int) -> None:
        self.inboxes[topic.name].deliver(KEY, payload(topic, seq))

    def take(self) -> list[tuple[str, int]]:
        return [(topic.name.split("/")[1], message.seq) for topic, message in self.intake.take()]


def test_a_core_gets_the_newest_of_state_and_all_of_events_in_order_of_arrival() -> None:
    gathered = Gathered()
    for topic, seq in ((topics.INTENT, 0), (topics.TASK, 0), (topics.INTENT, 1), (topics.TASK, 1), (topics.TASK, 2)):
        gathered.give(topic, seq)
    assert gathered.take() == [("task", 0), ("intent", 1), ("task", 1), ("task", 2)]
    assert gathered.inboxes["executive/intent"].health(0).skipped == 0, "the newest alone is wanted"
    assert gathered.take() == []


def test_only_triggers_wake_a_core() -> None:
    gathered = Gathered()
    gathered.give(topics.INTENT, 0)
    assert gathered.woken == 0
    gathered.give(topics.TASK, 0)
    assert gathered.woken == 1


def test_a_core_that_is_not_stepped_keeps_the_newest() -> None:
    gathered = Gathered(limit=3)
    for seq in range(10):
        gathered.give(topics.TASK, seq)
    assert gathered.take() == [("task", 7), ("task", 8), ("task", 9)]
    assert gathered.inboxes["executive/task"].health(0).skipped == 7


# --- over a bus -----------------------------------------------------------------------------------


@in_virtual_time
async def test_what_the_bus_overwrote_is_skipped_and_not_lost() -> None:
    mesh = LocalMesh()
    inbox, got = inbox_of(topics.BASE_STATE)
    inbox.subscription = mesh.join().subscribe(KEY, Qos.STATE, inbox.deliver, depth=2)
    publisher = mesh.join().publisher(KEY, Qos.STATE)
    publisher.put(payload(topics.BASE_STATE, 0))
    await asyncio.sleep(1)
    for seq in range(1, 7):
        publisher.put(payload(topics.BASE_STATE, seq))
    await asyncio.sleep(1)
    assert [message.seq for message in got] == [0, 5, 6]
    health = inbox.health(0)
    assert (health.skipped, health.lost) == (4, 0)
