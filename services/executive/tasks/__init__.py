"""The project's tasks, a file each. `TASKS` is the one place that lists them."""

from __future__ import annotations

from cocoro.tasks import Task, registry
from services.executive.tasks.arm import ParkTask, PutDownTask
from services.executive.tasks.babble import BabbleArmTask, BabbleWheelsTask
from services.executive.tasks.drive import DriveTask
from services.executive.tasks.fetch import FetchTask
from services.executive.tasks.follow import FollowTask
from services.executive.tasks.go_there import GoThereTask
from services.executive.tasks.go_to import GoToTask
from services.executive.tasks.policy import PolicyTask
from services.executive.tasks.touch import TouchTask

TASKS = registry(
    (FetchTask, FollowTask, TouchTask, GoToTask, GoThereTask, ParkTask, PutDownTask, DriveTask, PolicyTask,
     BabbleArmTask, BabbleWheelsTask)
)  # fmt: skip
"""All tasks by name, third parties' included."""

__all__ = [
    "TASKS",
    "BabbleArmTask",
    "BabbleWheelsTask",
    "DriveTask",
    "FetchTask",
    "FollowTask",
    "GoThereTask",
    "GoToTask",
    "ParkTask",
    "PolicyTask",
    "PutDownTask",
    "Task",
    "TouchTask",
]
