"""What a program can do with a robot: run tasks, look, read topics, drive by hand, stop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from types import TracebackType
from typing import Any, TypeVar

from apps.client import reading, seeing, status, stopping
from apps.client.drive import Drive
from apps.client.handle import TaskHandle, unknown_task
from apps.client.seeing import View
from apps.client.stated import stated_robot
from apps.client.status import RobotStatus
from apps.client.stopping import Released, StopPath, Stopped
from cocoro.contact import Contact
from cocoro.driving import TASK as DRIVE_TASK
from cocoro.driving import Driving
from cocoro.errors import ConfigError, choice_of
from cocoro.installed import all_topics, topic_named
from cocoro.messages import CancelRequest, KnownObject, Message, ObjectsRequest, ReportRequest, TaskRequest
from cocoro.participant import Participant
from cocoro.robot import Robot
from cocoro.task_errors import refusal
from cocoro.tasks import Task
from cocoro.topics import CANCEL, OBJECTS, REPORT, Topic
from services.executive.tasks import (
    FetchTask,
    FollowTask,
    GoThereTask,
    GoToTask,
    ParkTask,
    PolicyTask,
    PutDownTask,
    TouchTask,
)

M = TypeVar("M", bound=Message)


class RobotClient:
    """A robot, for a program. An asynchronous context manager; `cocoro.connect` makes one.

    Tasks that it began end with it, unless they are detached: the robot cancels them also when this process is killed
    or cut off. All methods raise MeshError when the service that they ask is not there, CallTimeoutError when it does
    not answer in time.
    """

    def __init__(
        self,
        participant: Participant,
        *,
        contact: Contact | None = None,
        described: Callable[[], Awaitable[Robot]] | None = None,
        stop_path: StopPath | None = None,
        by: str = "operator",
    ) -> None:
        """On the mesh of any bus, in virtual time, too; the participant is the caller's to close. `contact` knows what
        became of an executive that is not heard; `described` finds the robot's description, by default that which
        its services state; `stop_path` stops the robot on this machine beside the mesh; `by` is who stops and releases
        it."""
        self.participant = participant
        self._contact = contact
        self._described = described or partial(stated_robot, participant)
        self._stop_path = stop_path
        self._by = by
        self._handles: list[TaskHandle] = []
        self._description: Robot | None = None

    @property
    def name(self) -> str:
        """The robot's name."""
        return self.participant.robot_name

    async def __aenter__(self) -> RobotClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.end()

    async def end(self) -> None:
        """Cancels the tasks that run and are not detached, and waits until the robot stands."""
        await asyncio.gather(*(handle.end() for handle in self._handles))
        self._handles.clear()

    # --- tasks ------------------------------------------------------------------------------------

    def fetch(self, label: str, *, bring: bool = False, **options: Any) -> TaskHandle:
        """Find an object, drive there, grasp it and lift it; `bring`: to where the task began, and put it down there.
        `options` are those of `run`."""
        return self.run(FetchTask(label=label, bring=bring), **options)

    def follow(self, label: str, *, for_s: float | None = None, **options: Any) -> TaskHandle:
        """Keep behind an object that moves, for a time or until it is cancelled."""
        return self.run(FollowTask(label=label, for_s=for_s), **options)

    def touch(self, label: str, **options: Any) -> TaskHandle:
        """Bring the open hand around something within reach; the wheels stand."""
        return self.run(TouchTask(label=label), **options)

    def go_to(self, label: str, *, distance_m: float = 0.2, **options: Any) -> TaskHandle:
        """Drive to an object and stop at a distance from its nearest edge, from the robot's centre, over the floor."""
        return self.run(GoToTask(label=label, distance_m=distance_m), **options)

    def go_there(self, x_m: float, y_m: float, **options: Any) -> TaskHandle:
        """Drive to a place on the floor, odometry frame, around what stands in the way."""
        return self.run(GoThereTask(x_m=x_m, y_m=y_m), **options)

    def policy(self, name: str, *, for_s: float | None = None, **options: Any) -> TaskHandle:
        """Let a learned policy move the robot, within all limits, for a time or until it says that it has finished."""
        return self.run(PolicyTask(label=name, for_s=for_s), **options)

    def put_down(self, *, x_m: float | None = None, y_m: float | None = None, **options: Any) -> TaskHandle:
        """Set down what the hand holds: here, or at a place on the floor, odometry frame, which needs both."""
        return self.run(PutDownTask(x_m=x_m, y_m=y_m), **options)

    def park(self, **options: Any) -> TaskHandle:
        """Fold the arm."""
        return self.run(ParkTask(), **options)

    def run(
        self,
        task: Task | Mapping[str, Any],
        *,
        timeout_s: float | None = None,
        instead: bool = False,
        detach: bool = False,
    ) -> TaskHandle:
        """Ask for any task: its type, or a map such as `{"task": "fetch", "label": "red_can"}`, also of a third party's
        that only the robot has. The request is on its way when this returns; await the handle.

        `timeout_s`: the task fails after so long, instead of its own limit. `instead`: cancel the running task first,
        where the task would else be refused as busy. `detach`: the task goes on without this program.
        """
        request = TaskRequest(task=task, timeout_s=timeout_s, instead=instead)
        return self._keep(TaskHandle(self.participant, request, contact=self._contact, detached=detach))

    async def attend(self, task_id: str = "") -> TaskHandle:
        """A task that somebody else asked for: the running one, or the last, without an id. It is not cancelled with
        this program. Raises NoTaskError for one that the robot does not know."""
        state = await self.participant.call(REPORT, ReportRequest(task_id=task_id))
        if not state.task_id:
            raise unknown_task(self.name, task_id)
        return self._keep(TaskHandle(self.participant, None, contact=self._contact, detached=True, attended=state))

    async def cancel(self, task_id: str = "") -> str:
        """Cancel the running task, whoever asked for it, or that task if it runs; returns its id. Raises
        NoTaskError."""
        reply = await self.participant.call(CANCEL, CancelRequest(task_id=task_id))
        if not reply.accepted:
            raise refusal(reply)
        return reply.task_id

    @asynccontextmanager
    async def drive(self, *, instead: bool = False) -> AsyncIterator[Drive]:
        """Drive by hand while the block lasts: `await drive.move(Motion(speed_mps=0.2), for_s=1.0)`. Raises a
        TaskRefusedError; `instead` takes the robot from a running task."""
        async with self.run({"task": DRIVE_TASK}, instead=instead) as task:
            task_id = await task.accepted()
            async with Driving(self.participant, task_id) as driving:
                yield Drive(driving, task)

    def _keep(self, handle: TaskHandle) -> TaskHandle:
        self._handles = [each for each in self._handles if not each.done]
        self._handles.append(handle)
        return handle

    # --- looking ----------------------------------------------------------------------------------

    async def see(self, *, detections: bool = True) -> View:
        """The newest frame, with what perception made of that very frame unless `detections=False`, which is quicker.
        Raises MeshError when no frame comes within 5 s."""
        pairs = seeing.FramePairs(self.participant)
        pairs.open()
        frame, seen = await pairs.take(detections_s=seeing.DETECTIONS_S if detections else 0.0)
        if self._description is None:
            self._description = await self._described()
        return View(frame, seen, self._description)

    async def objects(self) -> tuple[KnownObject, ...]:
        """The objects that the robot knows, and where it saw each last."""
        return (await self.participant.call(OBJECTS, ObjectsRequest())).objects

    async def status(self) -> RobotStatus:
        """What the services report now."""
        return await status.status(self.participant)

    def watch(self, topic: Topic[M] | str) -> AsyncGenerator[M, None]:
        """The messages of a topic from now on, without end: the topic, or its name such as 'base/state'. A reader that
        is slow gets the newest; events are all kept. Raises ConfigError for an unknown name."""
        if isinstance(topic, str):
            found: Topic[Any] | None = topic_named(topic)
            if found is None:
                raise ConfigError(f"no such topic: {topic!r}; {choice_of(topic, (each.name for each in all_topics()))}")
            topic = found
        return reading.watched(self.participant, topic)

    # --- the emergency stop -----------------------------------------------------------------------

    async def stop(self) -> Stopped:
        """Emergency stop, now: everything that moves stands still until `reset`, the running task fails. Raises
        NotStoppedError when a service that moves something does not acknowledge it."""
        return await stopping.stop(self.participant, self._by, self._stop_path)

    async def reset(self) -> Released:
        """Release the emergency stop. Raises NotReleasedError when a service refuses, with its reason."""
        return await stopping.release(self.participant, self._by)
