"""The tasks, each an async function that reads like the task."""

from __future__ import annotations

from collections import Counter

from cocoro.messages import TaskRequest
from services.executive.config import ExecutiveConfig
from services.executive.skills import Skills, TaskFailedError

_LOOK_AGAIN = ("lost", "unreachable")
_TRY_AGAIN = ("slipped", "no_grip")


async def fetch(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Find it, drive there, reach, grasp, lift, and see that it stays held; bring it back if that was asked."""
    begun = robot.place()
    await _pick_up(robot, request.label, config)
    if request.bring:
        await robot.do("carry", request.label, place_m=begun, timeout_s=config.carry_timeout_s)
        await robot.do("place", timeout_s=config.place_timeout_s)


async def follow(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Find it and stay behind it, for the time that was asked or until cancelled; look for it when it is lost."""
    end_s = robot.now_s() + (request.for_s or float("inf"))
    await _find(robot, request.label, config)
    while robot.now_s() < end_s:
        try:
            await robot.keep_doing("follow", request.label, until_s=end_s)
        except TaskFailedError as failed:
            if failed.reason != "lost":
                raise
            await _find(robot, request.label, config)


async def touch(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Bring the open hand around what is within the arm's reach, on the floor or in the air; the base stands."""
    if not _known(robot, request.label):  # the hand may hide what it is about to leave
        await robot.do("search", request.label, timeout_s=config.search_timeout_s)
    await robot.do("touch", request.label, timeout_s=config.reach_timeout_s)


async def go_to(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Find it, drive there, and stop at the distance that was asked, which here is between the centres."""
    await _find(robot, request.label, config)
    await robot.do("go-to", request.label, distance_m=request.distance_m, timeout_s=config.approach_timeout_s)


async def park(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Fold the arm up."""
    await robot.do("park", timeout_s=config.park_timeout_s)


async def put_down(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Set down what is in the hand, here."""
    await robot.do("place", timeout_s=config.place_timeout_s)


async def babble_arm(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Move the arm about and look at the hand, until there are samples enough; fold the arm up again."""
    await robot.do("babble-arm", timeout_s=config.babble_timeout_s, first=request.first, count=request.count)
    await robot.do("park", timeout_s=config.park_timeout_s)


async def babble_wheels(robot: Skills, request: TaskRequest, config: ExecutiveConfig) -> None:
    """Find a target that stands before the robot, and turn the wheels to and fro before it."""
    await robot.do("park", timeout_s=config.park_timeout_s)
    await robot.do("search", request.label, timeout_s=config.search_timeout_s)
    await robot.do(
        "babble-wheels", request.label, timeout_s=config.babble_timeout_s, first=request.first, count=request.count
    )


def _known(robot: Skills, label: str) -> bool:
    status = robot.status
    return status is not None and any(item.label == label for item in status.known)


async def _pick_up(robot: Skills, label: str, config: ExecutiveConfig) -> None:
    tries: Counter[str] = Counter()
    while True:
        try:
            await _find(robot, label, config)
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


async def _find(robot: Skills, label: str, config: ExecutiveConfig) -> None:
    """Look all around; where it is not in view, go and look from elsewhere."""
    for left in reversed(range(config.viewpoints)):
        try:
            await robot.do("search", label, timeout_s=config.search_timeout_s)
            return
        except TaskFailedError as failed:
            if failed.reason != "not_found" or left == 0:
                raise
        await robot.do("explore", label, timeout_s=config.explore_timeout_s)
