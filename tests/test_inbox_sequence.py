"""Sequence numbers that cannot be right, and streams that began anew: what is taken, rejected and counted as lost."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from inbox_rig import FAR, KEY, StillClock, inbox_of, payload

from cocoro import topics
from cocoro.clock import NS
from cocoro.stream_checks import FOLLOWED_AFTER, FREE_JUMP
from cocoro.topics import Topic

PERIOD_NS = NS // 50


class Talk:
    """A publisher of base states at 50 Hz, and its reader; `clock` goes with it."""

    def __init__(self, topic: Topic[Any] = topics.BASE_STATE, seq: int = 0) -> None:
        self.topic = topic
        self.clock = StillClock()
        self.inbox, self.got = inbox_of(topic, self.clock)
        self.seq = seq

    def say(self, count: int = 1, pause_s: float = 0.0) -> None:
        """Messages as they should be, after a pause in which nothing was said."""
        self.clock.at_ns += round(pause_s * NS)
        for _ in range(count):
            self.clock.at_ns += PERIOD_NS
            self.deliver(self.seq)
            self.seq += 1

    def deliver(self, seq: int, ahead_s: float = 0.0, incarnation: int = 1) -> None:
        stamp_ns = self.clock.at_ns + round(ahead_s * NS)
        self.inbox.deliver(KEY, payload(self.topic, seq, incarnation, stamp_ns))

    @property
    def taken(self) -> list[int]:
        return [message.seq for message in self.got]

    @property
    def lost(self) -> int:
        return self.inbox.health(0).lost


@pytest.mark.parametrize("topic", [topics.BASE_STATE, topics.BASE_COMMAND, topics.TASK], ids=lambda topic: topic.name)
def test_a_number_that_cannot_be_traffic_is_rejected_and_nothing_after_it(topic: Topic[Any]) -> None:
    talk = Talk(topic)
    talk.say(10)
    talk.deliver(FAR)
    talk.say(10)
    assert talk.taken == list(range(20))
    assert (talk.inbox.rejected, talk.lost) == (1, 0)
    assert talk.inbox.last_error == f"sequence number {FAR} after 9 cannot be traffic"


def test_many_such_numbers_between_good_messages_change_nothing() -> None:
    talk = Talk()
    for seq in range(50):
        talk.say()
        talk.deliver(FAR + seq)
    assert talk.taken == list(range(50))
    assert (talk.inbox.rejected, talk.lost) == (50, 0)


@pytest.mark.parametrize("ahead", [3, 500, FREE_JUMP])
def test_a_wrong_number_that_could_be_traffic_costs_three_messages_and_no_loss_is_counted(ahead: int) -> None:
    talk = Talk()
    talk.say(10)
    talk.deliver(9 + ahead)
    talk.say(20)
    after = [seq for seq in range(10, 30) if seq in talk.taken]
    assert after[0] <= 9 + FOLLOWED_AFTER
    assert after == list(range(after[0], 30))
    assert talk.lost == 0


@pytest.mark.parametrize("ahead_s", [0.0, 0.25])
def test_a_wrong_number_in_the_very_first_message_is_forgotten_soon(ahead_s: float) -> None:
    talk = Talk(seq=700)
    talk.deliver(FAR, ahead_s)
    talk.say(40)
    in_vain = FOLLOWED_AFTER - 1 + round(ahead_s * NS / PERIOD_NS)
    assert talk.taken == [FAR, *range(700 + in_vain, 740)]
    assert talk.lost == 0


def test_losses_of_any_length_are_counted_when_time_has_passed_for_them() -> None:
    talk = Talk()
    talk.say(10)
    talk.seq += 180_000  # an hour at 50 Hz, in which this process was stopped
    talk.say(1, pause_s=3600.0)
    assert talk.taken[-1] == 180_010
    assert (talk.inbox.rejected, talk.lost) == (0, 180_000)


def test_a_stream_that_began_anew_far_ahead_is_followed_after_three_messages() -> None:
    talk = Talk()
    talk.say(10)
    talk.seq = 10_000_000
    talk.say(10)
    assert talk.taken[10:] == list(range(10_000_002, 10_000_010))
    assert (talk.inbox.rejected, talk.lost) == (2, 0)


def test_what_is_lost_of_a_stream_that_is_followed_anew_is_counted() -> None:
    talk = Talk()
    talk.say(10)
    for seq in (10_000_000, 10_000_003, 10_000_004, 10_000_007):
        talk.seq = seq
        talk.say()
    assert (talk.inbox.rejected, talk.lost) == (2, 4)


def test_a_burst_of_old_messages_is_rejected_however_long_it_is() -> None:
    talk = Talk()
    talk.say(50)
    for _ in range(3):
        for seq in range(50):
            talk.deliver(seq, ahead_s=-(50 - seq) * PERIOD_NS / NS)
    talk.say(5)
    assert talk.taken == list(range(55))
    assert talk.inbox.rejected == 150


def test_a_message_that_was_rejected_for_its_stamp_is_not_counted_as_lost_as_well() -> None:
    talk = Talk(topics.BASE_COMMAND)
    talk.say(3)
    talk.deliver(3, ahead_s=-1.0)
    talk.deliver(4, ahead_s=+1.0)
    talk.seq = 6
    talk.say(2)
    assert talk.taken == [0, 1, 2, 6, 7]
    assert (talk.inbox.rejected, talk.lost) == (2, 1), "5 was lost"


def test_a_stale_command_as_if_of_another_publisher_does_not_change_who_is_followed() -> None:
    talk = Talk(topics.BASE_COMMAND)
    talk.say(3)
    talk.deliver(10, ahead_s=-1.0, incarnation=99)
    talk.deliver(2)
    assert talk.taken == [0, 1, 2], "and a repeated one is still known as such"


@pytest.mark.parametrize("topic", [topics.BASE_COMMAND, topics.INTENT], ids=lambda topic: topic.name)
def test_a_command_of_a_second_publisher_is_rejected_while_the_first_one_commands(topic: Topic[Any]) -> None:
    talk = Talk(topic)
    for number in range(10):
        talk.say()
        talk.deliver(number, incarnation=99)
    assert talk.taken == list(range(10))
    assert {message.incarnation for message in talk.got} == {1}
    assert talk.inbox.last_error == "publisher 63 commands while 1 does"
    assert (talk.inbox.rejected, talk.lost) == (10, 0)


def test_a_publisher_that_was_restarted_is_followed_once_the_last_command_has_expired() -> None:
    talk = Talk(topics.BASE_COMMAND)
    talk.say(3)
    talk.clock.at_ns += round(topics.BASE_COMMAND.max_age_s * NS)
    talk.deliver(0, incarnation=2)
    assert talk.taken == [0, 1, 2]
    assert talk.inbox.rejected == 1, "it is as old as a command may be"
    talk.clock.at_ns += 1
    talk.deliver(1, incarnation=2)
    talk.deliver(2, incarnation=2)
    assert talk.taken == [0, 1, 2, 1, 2]


@given(
    st.lists(
        st.tuples(st.sampled_from(["good", "lost", "far", "again", "ahead", "behind"]), st.integers(1, 400)),
        max_size=60,
    )
)
def test_whatever_bad_message_comes_between_good_ones_soon_all_good_ones_are_taken(
    events: list[tuple[str, int]],
) -> None:
    """The counted losses are the true ones, unless a wrong number passed for traffic."""
    talk = Talk()
    lost, passed = 0, False
    talk.say()
    for what, number in events:
        if what == "lost":
            talk.seq += number
            lost += number
            talk.say(1, pause_s=number * PERIOD_NS / NS)
        elif what == "good":
            talk.say(number % 5)
        elif what == "far":
            talk.deliver(FAR + number)
        elif what == "again":
            talk.deliver(max(talk.seq - number, 0), ahead_s=-number * PERIOD_NS / NS)
        elif what == "ahead":
            talk.deliver(talk.seq, ahead_s=number)
            talk.seq += 1
        else:
            talk.deliver(talk.seq + number)
            passed = True
    before = len(talk.got)
    talk.say(FOLLOWED_AFTER + 10)
    assert len(talk.got) - before >= 10
    assert talk.taken[-10:] == list(range(talk.seq - 10, talk.seq))
    if not passed:
        assert talk.lost == lost
