"""The tasks, each an async function that reads like the task."""

from __future__ import annotations

from collections import Counter

from services.executive.config import Config
from services.executive.skills import Skills, TaskFailedError

_LOOK_AGAIN = ("lost", "unreachable")
_TRY_AGAIN = ("slipped", "no_grip")


async def fetch(robot: Skills, label: str, config: Config) -> None:
    """Find it, drive there, reach, grasp, lift, and see that it stays held."""
    tries: Counter[str] = Counter()
    while True:
        try:
            await robot.do("search", label, timeout_s=config.search_timeout_s)
            await robot.do("approach", label, timeout_s=config.approach_timeout_s)
            await robot.do("reach", label, timeout_s=config.reach_timeout_s)
            await robot.do("grasp", label, timeout_s=config.grasp_timeout_s)
            await robot.do("lift", label, timeout_s=config.lift_timeout_s)
            await robot.watch_hold(config.hold_s)
            return
        except TaskFailedError as failed:
            kind = "look" if failed.reason in _LOOK_AGAIN else "try" if failed.reason in _TRY_AGAIN else ""
            tries[kind] += 1
            allowed = {"look": config.relocate_tries, "try": config.grasp_tries - 1}.get(kind, 0)
            if tries[kind] > allowed:
                raise


async def park(robot: Skills, label: str, config: Config) -> None:
    """Fold the arm up."""
    await robot.do("park", timeout_s=config.park_timeout_s)


async def put_down(robot: Skills, label: str, config: Config) -> None:
    """Set down what is in the hand, here."""
    await robot.do("place", timeout_s=config.place_timeout_s)
