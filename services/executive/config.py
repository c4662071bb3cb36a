"""Configuration of the executive: a profile's `[service.executive]` table."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.tasks import Limits
from cocoro.units import Positive
from services.executive.component import EXECUTIVE


class ExecutiveConfig(Limits, frozen=True, forbid_unknown_fields=True):
    objects: str = ""
    """A catalogue of known objects; empty is the project's own."""
    needed: tuple[str, ...] = EXECUTIVE.needs
    """Services without which no task starts, and at whose death a running one fails. A profile fills in those that
    the declarations of its components give."""
    battery_low: Annotated[float, Meta(ge=0, le=1)] = 0.15
    """With less in the base's battery only tasks start that do without (`Task.needs_battery`)."""
    intent_hz: Positive = 50.0
    progress_hz: Positive = 5.0
    latch_hz: Positive = 5.0
    latch_wait_s: Positive = 5.0
    """How long the executive waits at its start until it is known whether the emergency stop is latched."""
    settle_s: Positive = 3.0
    """How long the executive waits after a task for the robot to come to rest."""
    planner_late_s: Positive = 0.5
    """After so long without news of the planner, the task's state says that it waits for the planner. The hardware has
    stopped by itself before; the task goes on when there is news."""
    planner_silence_s: Positive = 10.0
    """After so long without news of the planner, while this process runs, the task fails."""
    contact_s: Positive = 10.0
    """After so long without a needed service that died, or contact with which was lost, the task fails."""
    resumptions: Annotated[int, Meta(ge=0)] = 3
    """How often a task goes on after a needed service was lost (see `services.executive.recovery`)."""
