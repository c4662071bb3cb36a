"""Rejected messages in the health of their reader."""

from __future__ import annotations

import asyncio

import pytest
from inbox_rig import KEY, inbox_of, payload

from cocoro import topics
from cocoro.stream_checks import REPORTED_S, UNREADABLE_S, UNTIMELY_S
from cocoro.testing import in_virtual_time


@pytest.mark.parametrize(
    ("bad", "limit_s", "what"),
    [
        ({"stamp_ns": 1}, UNTIMELY_S, "stale: stamped 100.000 s ago"),
        ({"seq": 0}, UNREADABLE_S, "sequence number 0 after 0 was there before"),
    ],
)
def test_a_topic_of_which_everything_is_rejected_is_unreadable_and_says_whose_fault_it_is(
    bad: dict[str, int], limit_s: float, what: str
) -> None:
    in_virtual_time(unreadable_after)(bad, limit_s, what)


async def unreadable_after(bad: dict[str, int], limit_s: float, what: str) -> None:
    inbox, _ = inbox_of(topics.BASE_COMMAND)
    told: list[bool] = []
    inbox.rejections.changed = lambda: told.append(inbox.rejections.unreadable)
    inbox.deliver("calliope/base/command", payload(topics.BASE_COMMAND))
    assert (inbox.health(0).fault, inbox.health(0).unreadable) == ("", False)
    began_s = asyncio.get_running_loop().time()
    while not inbox.rejections.unreadable:
        inbox.deliver("calliope/base/command", payload(topics.BASE_COMMAND, **bad))
        await asyncio.sleep(0.02)
    assert asyncio.get_running_loop().time() - began_s == pytest.approx(limit_s, abs=0.05)
    why = f"base/command of planning: {inbox.rejected} rejected: {what}"
    assert (inbox.health(0).fault, inbox.health(0).unreadable) == (why, True)
    inbox.deliver("calliope/base/command", payload(topics.BASE_COMMAND, seq=1))
    assert (inbox.health(0).fault, inbox.health(0).unreadable) == (why, False)
    assert told == [True, False]
    await asyncio.sleep(REPORTED_S + 0.1)
    assert inbox.health(0).fault == ""


@in_virtual_time
async def test_bad_messages_among_good_ones_and_on_quiet_topics_make_nothing_unreadable() -> None:
    often, _ = inbox_of(topics.BASE_STATE)
    quiet, _ = inbox_of(topics.MODEL)
    for seq in range(100):
        for _ in range(10):
            often.deliver(KEY, b"rubbish")
            quiet.deliver(KEY, b"rubbish")
        often.deliver(KEY, payload(topics.BASE_STATE, seq))
        await asyncio.sleep(0.02)
    assert not often.rejections.unreadable
    assert not quiet.rejections.unreadable


def test_of_a_per_service_topic_the_service_is_named() -> None:
    inbox, _ = inbox_of(topics.HEALTH.of("*"))
    inbox.deliver("calliope/arm/health", b"")
    assert inbox.health(0).fault.startswith("arm/health of arm: 1 rejected: ")
