"""Turns what a policy returns into the message that proposes it, and refuses what nobody can follow."""

from __future__ import annotations

from typing import Any

import numpy as np

from cocoro.features import MOST_ROWS, PolicyFeatures
from cocoro.messages import LARGEST, PolicyActions
from cocoro.policy import PolicyError
from cocoro.robot import Robot
from services.policy.observing import Observed


def proposal(
    actions: Any, observed: Observed, features: PolicyFeatures, robot: Robot, task_id: str, step: int
) -> PolicyActions:
    """The message. `actions`: as `cocoro.policy.Policy.act` returns them. Raises PolicyError for anything else."""
    seen: dict[str, int] = {
        "observed_ns": observed.stamp_ns, "frame_seq": observed.seq, "frame_incarnation": observed.incarnation
    }  # fmt: skip
    if actions is None:
        return PolicyActions(task_id=task_id, step=step, state="done", **seen)  # type: ignore[arg-type]
    rows = _rows(actions, features)
    joints = tuple(robot.joints)
    base = rows[:, len(joints) :]
    return PolicyActions(
        task_id=task_id,
        step=step,
        **seen,  # type: ignore[arg-type]
        period_s=1.0 / features.rate_hz,
        joints=joints,
        goal_rad=tuple(map(tuple, rows[:, : len(joints)].tolist())),
        ahead_mps=tuple(base[:, 0].tolist()),
        turn_radps=tuple(base[:, -1].tolist()),
        aside_mps=tuple(base[:, 1].tolist()) if robot.drive.goes_aside else (),
    )


def refusal(reason: str, task_id: str, step: int) -> PolicyActions:
    return PolicyActions(task_id=task_id, step=step, state="refused", text=reason)


def _rows(actions: Any, features: PolicyFeatures) -> np.ndarray[Any, Any]:
    """Shape (rows, values)."""
    try:
        rows = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PolicyError(f"its actions are no numbers: {error}") from error
    if rows.ndim == 1:
        rows = rows[None]
    wanted = (features.chunk, len(features.action))
    if rows.shape != wanted:
        raise PolicyError(f"its actions have the shape {rows.shape}; {wanted} was declared: rows and values")
    bad = ~(np.abs(rows) <= LARGEST)  # NaN, too
    if bad.any():
        row, value = (int(place) for place in np.argwhere(bad)[0])
        raise PolicyError(f"its action {features.action[value]} of row {row} is {rows[row, value]}, no finite number")
    assert len(rows) <= MOST_ROWS
    return rows
