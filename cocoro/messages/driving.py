"""Driving by hand: the motion that an operator wants now, and the requests that carry it."""

from __future__ import annotations

from typing import Literal

import msgspec

from cocoro.messages.common import Count, Finite

HOLD_S = 0.2
"""A motion moves the robot for at most so long after the executive issued the tick that its request quotes."""


class Motion(msgspec.Struct, kw_only=True, frozen=True):
    """The motion that an operator wants now. What is beyond the robot's limits is reduced to them; all zero is rest."""

    speed_mps: Finite = 0.0
    """Of the base, forwards."""
    turn_radps: Finite = 0.0
    """Of the base, counter-clockwise."""
    aside_mps: Finite = 0.0
    """Of the base, to the left. A base that cannot move so does not."""
    pan_radps: Finite = 0.0
    """Of the head, to the left."""
    tilt_radps: Finite = 0.0
    """Of the head, upwards."""
    out_mps: Finite = 0.0
    """Of the hand, away from the arm's axis."""
    round_radps: Finite = 0.0
    """Of the hand, about the arm's axis, counter-clockwise."""
    up_mps: Finite = 0.0
    """Of the hand, upwards."""
    roll_radps: Finite = 0.0
    """Of the wrist."""
    grip: Literal["", "open", "close"] = ""
    """What the claws begin to do; they complete it also when the motion has ended."""

    @property
    def zero(self) -> bool:
        """Whether nothing is to move."""
        return self == _REST

    @property
    def base(self) -> bool:
        """Whether the wheels are to turn."""
        return any((self.speed_mps, self.turn_radps, self.aside_mps))

    @property
    def head(self) -> bool:
        """Whether the head is to turn."""
        return self.pan_radps != 0.0 or self.tilt_radps != 0.0

    @property
    def hand(self) -> bool:
        """Whether arm or wrist are to move."""
        return any((self.out_mps, self.round_radps, self.up_mps, self.roll_radps))


_REST = Motion()

DriveRefusal = Literal["no_task", "no_tick", "other_driver", "waiting"]
"""Why a motion does not count: no such task drives by hand now; the request quotes no good tick; another driver moves
the robot; the task waits for a service."""


class DriveRequest(msgspec.Struct, kw_only=True):
    """One input of an operator, at most `HOLD_S` after the answer to his last one."""

    task_id: str
    """Of a running task `drive`."""
    tick: Count = 0
    """From the last reply. Each tick can be quoted once, while it is not older than `HOLD_S`. 0: none is known; the
    reply brings one."""
    motion: Motion = Motion()


class DriveReply(msgspec.Struct, kw_only=True):
    accepted: bool
    """Whether the motion counts."""
    tick: Count = 0
    """To quote in the next request; 0 when the task does not run."""
    refusal: DriveRefusal | None = None
    text: str = ""
    """For a refusal: the reason, one sentence for people."""
