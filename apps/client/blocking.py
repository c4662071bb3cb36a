"""`cocoro.connect_blocking`: the client for programs without asyncio, and for notebooks.

The mesh lives in a thread of its own. A method returns when the robot has done what it says, or raises what the
asynchronous one raises. Ctrl-C, or a notebook's stop button, cancels the task that is waited for.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from functools import partial
from types import TracebackType
from typing import Any, Generic, TypeVar

from apps.client.connecting import connect
from apps.client.drive import Drive
from apps.client.handle import TaskHandle, TaskResult
from apps.client.robot import RobotClient
from apps.client.seeing import View
from apps.client.status import RobotStatus
from apps.client.stopping import Released, Stopped
from cocoro.errors import CocoroError
from cocoro.messages import DriveReply, KnownObject, Message, Motion, TaskState
from cocoro.tasks import Task
from cocoro.topics import Topic

T = TypeVar("T")
M = TypeVar("M", bound=Message)


class _Work(Generic[T]):
    """A coroutine whose result another thread waits for."""

    def __init__(self, work: Callable[[], Coroutine[Any, Any, T]]) -> None:
        self.result: Future[T] = Future()
        self._work = work
        self._task: asyncio.Task[T] | None = None

    def begin(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._work())
        self._task.add_done_callback(self._ended)

    def cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    def _ended(self, task: asyncio.Task[T]) -> None:
        if task.cancelled():
            self.result.cancel()
        elif (error := task.exception()) is not None:
            self.result.set_exception(error)
        else:
            self.result.set_result(task.result())


class _Thread:
    """An event loop in a thread; carries out coroutines for other threads."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="cocoro client", daemon=True)
        self._thread.start()

    def do(self, work: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """The result of a coroutine. An interrupt of the caller cancels it and waits until it has ended; a second one
        does not wait."""
        if self._loop.is_closed():
            raise CocoroError("the client is closed: connect again")
        begun = _Work(work)
        self._loop.call_soon_threadsafe(begun.begin)
        try:
            return begun.result.result()
        except BaseException:
            if not begun.result.done():
                self._loop.call_soon_threadsafe(begun.cancel)
                with suppress(CocoroError, CancelledError):
                    begun.result.result()
            raise

    def end(self) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()


class BlockingTask:
    """A task that goes on while the program does other things, from `BlockingRobot.start`."""

    def __init__(self, thread: _Thread, handle: TaskHandle) -> None:
        self._thread = thread
        self._handle = handle

    def __repr__(self) -> str:
        return repr(self._handle)

    @property
    def task_id(self) -> str:
        return self._handle.task_id

    @property
    def state(self) -> TaskState | None:
        """The newest state; None before the first."""
        return self._handle.state

    @property
    def done(self) -> bool:
        """Whether it is over, however it ended."""
        return self._handle.done

    def result(self) -> TaskResult:
        """Waits for its end. Raises TaskRefusedError, TaskEndedError; see `TaskHandle`."""
        return self._thread.do(lambda: _awaited(self._handle))

    def cancel(self) -> TaskState | None:
        """Cancels it on the robot; see `TaskHandle.cancel`."""
        return self._thread.do(self._handle.cancel)

    def __iter__(self) -> Iterator[TaskState]:
        """Each state as it comes; raises what `result` raises."""
        return _steps(self._thread, self._handle.__aiter__())


class BlockingDrive:
    """The robot in a program's hand, from `BlockingRobot.drive`."""

    def __init__(self, thread: _Thread, drive: Drive) -> None:
        self._thread = thread
        self._drive = drive

    @property
    def reply(self) -> DriveReply:
        """The robot's last answer: whether the motion counts, and why not."""
        return self._drive.reply

    def move(self, motion: Motion, for_s: float) -> None:
        """Asks for a motion for some seconds, then for rest; see `Drive.move`."""
        self._thread.do(lambda: self._drive.move(motion, for_s))


class BlockingRobot:
    """A robot, for a program without asyncio. Close it, or use it in a `with` statement. The methods are those of
    `RobotClient`; those of tasks return when the task is done, and raise a `TaskRefusedError` or a `TaskEndedError`."""

    def __init__(self, robot: str | None = None, *, site: str | None = None) -> None:
        """Raises what `cocoro.connect` raises."""
        self._thread = _Thread()
        self._connection = connect(robot, site=site)
        try:
            self._robot: RobotClient = self._thread.do(self._connection.__aenter__)
        except BaseException:
            self._thread.end()
            raise

    @property
    def name(self) -> str:
        """The robot's name."""
        return self._robot.name

    def __repr__(self) -> str:
        return f"<{self.name}>"

    def close(self) -> None:
        """Cancels what runs and is not detached, waits until the robot stands, and leaves the mesh."""
        with suppress(CocoroError):  # it is closed already
            self._thread.do(lambda: self._connection.__aexit__(None, None, None))
        self._thread.end()

    def __enter__(self) -> BlockingRobot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- tasks ------------------------------------------------------------------------------------

    def fetch(self, label: str, *, bring: bool = False, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.fetch(label, bring=bring, **options))

    def follow(self, label: str, *, for_s: float | None = None, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.follow(label, for_s=for_s, **options))

    def touch(self, label: str, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.touch(label, **options))

    def go_to(self, label: str, *, distance_m: float = 0.2, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.go_to(label, distance_m=distance_m, **options))

    def go_there(self, x_m: float, y_m: float, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.go_there(x_m, y_m, **options))

    def policy(self, name: str, *, for_s: float | None = None, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.policy(name, for_s=for_s, **options))

    def put_down(self, *, x_m: float | None = None, y_m: float | None = None, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.put_down(x_m=x_m, y_m=y_m, **options))

    def park(self, **options: Any) -> TaskResult:
        return self._done(lambda: self._robot.park(**options))

    def run(self, task: Task | Mapping[str, Any], **options: Any) -> TaskResult:
        """Run any task to its end; see `RobotClient.run`."""
        return self._done(lambda: self._robot.run(task, **options))

    def start(self, task: Task | Mapping[str, Any], **options: Any) -> BlockingTask:
        """Begin any task and return when the robot has begun it. Raises TaskRefusedError."""

        async def begun() -> TaskHandle:
            handle = self._robot.run(task, **options)
            try:
                await handle.accepted()
            except asyncio.CancelledError:
                await handle.end()
                raise
            return handle

        return BlockingTask(self._thread, self._thread.do(begun))

    def attend(self, task_id: str = "") -> BlockingTask:
        """A task that somebody else asked for; see `RobotClient.attend`."""
        return BlockingTask(self._thread, self._thread.do(lambda: self._robot.attend(task_id)))

    def cancel(self, task_id: str = "") -> str:
        """Cancel the running task; see `RobotClient.cancel`."""
        return self._thread.do(lambda: self._robot.cancel(task_id))

    @contextmanager
    def drive(self, *, instead: bool = False) -> Iterator[BlockingDrive]:
        """Drive by hand while the block lasts; see `RobotClient.drive`."""
        driving = self._robot.drive(instead=instead)
        drive = self._thread.do(driving.__aenter__)
        try:
            yield BlockingDrive(self._thread, drive)
        finally:
            self._thread.do(lambda: driving.__aexit__(None, None, None))

    def _done(self, begin: Callable[[], TaskHandle]) -> TaskResult:
        async def done() -> TaskResult:
            handle = begin()
            try:
                return await handle
            except asyncio.CancelledError:
                if not handle.detached:
                    await handle.end()
                raise

        return self._thread.do(done)

    # --- looking, stopping ------------------------------------------------------------------------

    def see(self, *, detections: bool = True) -> View:
        """What the robot sees now; see `RobotClient.see`."""
        return self._thread.do(partial(self._robot.see, detections=detections))

    def objects(self) -> tuple[KnownObject, ...]:
        """The objects that the robot knows, and where it saw each last."""
        return self._thread.do(self._robot.objects)

    def status(self) -> RobotStatus:
        """What the services report now."""
        return self._thread.do(self._robot.status)

    def watch(self, topic: Topic[M] | str) -> Iterator[M]:
        """The messages of a topic from now on; see `RobotClient.watch`."""
        return _steps(self._thread, self._robot.watch(topic))

    def stop(self) -> Stopped:
        """Emergency stop, now; see `RobotClient.stop`."""
        return self._thread.do(self._robot.stop)

    def reset(self) -> Released:
        """Release the emergency stop; see `RobotClient.reset`."""
        return self._thread.do(self._robot.reset)


def connect_blocking(robot: str | None = None, *, site: str | None = None) -> BlockingRobot:
    """Joins a robot's mesh, for programs without asyncio: `with cocoro.connect_blocking() as robot: ...`. `robot` and
    `site` as in `cocoro.connect`, which says what it raises."""
    return BlockingRobot(robot, site=site)


async def _awaited(handle: TaskHandle) -> TaskResult:
    return await handle


def _steps(thread: _Thread, source: AsyncGenerator[T, None]) -> Iterator[T]:
    """An asynchronous iterator, step by step; it is closed when this one is."""

    async def step() -> tuple[T] | None:
        try:
            return (await anext(source),)
        except StopAsyncIteration:
            return None

    try:
        while (item := thread.do(step)) is not None:
            yield item[0]
    finally:
        with suppress(CocoroError):  # the client is closed already
            thread.do(source.aclose)
