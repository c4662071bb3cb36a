"""Asks a host of a site for its robot's time: once in a while by gateways, and once by a person's command."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import msgspec

from cocoro.clock import RealClock, steady_ns
from cocoro.errors import CocoroError
from cocoro.messages import TimeReply, TimeRequest
from cocoro.participant import Participant
from cocoro.topics import TIME
from deploy.site.component import gateway_of
from deploy.site.offset_estimate import Sample, sample

ANSWER_S = TIME.timeout_s
"""Longest wait for an answer."""
ASKED = 3
"""A command takes the best of so many answers."""
APART_S = 0.005
_QUESTION = msgspec.msgpack.encode(TimeRequest())
_DECODER = msgspec.msgpack.Decoder(TimeReply)


async def exchange(participant: Participant, host: str, steady: Callable[[], int] = steady_ns) -> Sample | None:
    """Asks a host for its time, once; None without a good answer."""
    key = TIME.of(gateway_of(host).name).key(participant.robot_name)
    sent_ns = steady()
    try:
        replies = await participant.bus.call(key, _QUESTION, ANSWER_S)
        back_ns = steady()
        if not replies or not replies[0].ok:
            return None
        reply = _DECODER.decode(replies[0].payload)
    except (CocoroError, msgspec.MsgspecError):
        return None
    return sample(sent_ns, reply.received_ns, reply.answered_ns, back_ns)


async def time_of(participant: Participant, host: str) -> RealClock | None:
    """A clock that has a host's time, to half a round trip, for a command; None when the host does not answer."""
    answers = []
    for _ in range(ASKED):
        answer = await exchange(participant, host)
        if answer is None:
            break
        answers.append(answer)
        await asyncio.sleep(APART_S)
    return RealClock(min(answers, key=lambda one: one.round_trip_ns).ahead_ns) if answers else None
