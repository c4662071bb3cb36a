"""What a learned policy proposes to the planner."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from cocoro.messages.common import Count, Finite, FiniteNonNegative, Message, require_finite

Rows = Meta(max_length=256)


class PolicyActions(Message):
    """A chunk of actions: rows at equal periods, the first for the time of the observation that they were made of. The
    planner follows as much of them as is safe. Or why there are none, and none will come."""

    task_id: str
    step: Count
    """Those of the intent that it answers."""
    state: Literal["running", "done", "refused"] = "running"
    """done: the policy says that it has finished; refused: it cannot run, or has proposed what nobody can follow."""
    text: str = ""
    """For 'refused': the reason, one sentence for people."""
    observed_ns: int = 0
    """Stamp of the picture that it was made of, and time of the first row."""
    frame_seq: Count = 0
    frame_incarnation: Count = 0
    """Those of the picture."""
    period_s: FiniteNonNegative = 0.0
    joints: tuple[str, ...] = ()
    goal_rad: Annotated[tuple[tuple[Finite, ...], ...], Rows] = ()
    """By row, the goals of all `joints`, in their order."""
    ahead_mps: Annotated[tuple[Finite, ...], Rows] = ()
    turn_radps: Annotated[tuple[Finite, ...], Rows] = ()
    """By row, the wanted speed and turn rate of the base."""
    aside_mps: Annotated[tuple[Finite, ...], Rows] = ()
    """By row, to the left; empty of a base that cannot."""

    def __post_init__(self) -> None:
        rows = len(self.goal_rad)
        for name in ("ahead_mps", "turn_radps", "aside_mps"):
            if len(getattr(self, name)) != rows and not (name == "aside_mps" and not self.aside_mps):
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {rows} rows")
        for number, goals in enumerate(self.goal_rad):
            if len(goals) != len(self.joints):
                raise ValueError(f"row {number} has {len(goals)} goals for {len(self.joints)} joints")
        if self.state == "running" and not (rows and self.period_s > 0.0):
            raise ValueError("a chunk that is to be followed has rows and a period")
        require_finite(self, "ahead_mps", "turn_radps", "aside_mps", "period_s")

    @property
    def rows(self) -> int:
        return len(self.goal_rad)
