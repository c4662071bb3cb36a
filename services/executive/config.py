"""What can be tuned in the executive; a profile's `[service.executive]` table sets these."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.units import Positive
from services.executive.component import EXECUTIVE


class ExecutiveConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    objects: str = ""
    """A catalogue of known objects; empty is the project's own."""
    needed: tuple[str, ...] = EXECUTIVE.needs
    """Services without which no task starts, and at whose death a running one fails. A profile fills in those that
    the declarations of its components give."""
    battery_low: Annotated[float, Meta(ge=0, le=1)] = 0.15
    """With less in the base's battery no task starts; putting down what is in the hand is allowed."""
    intent_hz: Positive = 50.0
    progress_hz: Positive = 5.0
    latch_hz: Positive = 5.0
    task_timeout_s: Positive = 180.0
    search_timeout_s: Positive = 60.0
    viewpoints: Annotated[int, Meta(ge=1)] = 3
    """Places from which a target is looked for before it is not found."""
    explore_timeout_s: Positive = 20.0
    approach_timeout_s: Positive = 60.0
    carry_timeout_s: Positive = 90.0
    reach_timeout_s: Positive = 20.0
    grasp_timeout_s: Positive = 6.0
    lift_timeout_s: Positive = 15.0
    place_timeout_s: Positive = 25.0
    babble_timeout_s: Positive = 86_400.0
    park_timeout_s: Positive = 20.0
    hold_s: Positive = 2.3
    """A lifted thing must stay held for so long before a fetch is done."""
    settle_s: Positive = 3.0
    """After a task the robot is given so long to come to rest."""
    planner_silence_s: Positive = 1.5
    """A planner that says nothing for so long fails the task. What moves has stopped long before, by the hardware."""
    relocate_tries: int = 3
    """Times that a target may be lost or out of reach and be approached again."""
    grasp_tries: int = 2
    """A second try after a slip."""
