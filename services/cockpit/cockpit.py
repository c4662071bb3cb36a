"""The cockpit between the mesh and its viewers: who looks, what they see, what they ask for."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from cocoro import private
from cocoro.messages import FloorPlan, Frame, Message
from cocoro.node import Node
from cocoro.topics import ANY, RECORDING, Topic
from services.cockpit.access import Visitor
from services.cockpit.asking import Asker
from services.cockpit.config import CockpitConfig
from services.cockpit.feed import Feed
from services.cockpit.log_lines import FIRST_LINES, LogLines
from services.cockpit.outbox import Kind, Outbox
from services.cockpit.pictures import Looking, Pictures, Viewing, levels
from services.cockpit.scene import Scene, encoded
from services.cockpit.shelf import Shelf
from services.cockpit.stopping import Stopper

T = TypeVar("T")

STATE_HZ = 10.0
SHOWN_OF_FLOOR = ("cells", "way_m", "goal_m", "origin_m", "width", "height", "cell_m")
LOG_S = 0.3
"""Period in which the log is looked at for new lines."""
WRITTEN_S = 0.3
"""Longest wait for a recorder to tell what it writes."""


class Viewer:
    """One page that looks."""

    def __init__(self, looking: Looking, visitor: Visitor) -> None:
        self.outbox = Outbox()
        self.looking = looking
        self.visitor = visitor
        self.log = False
        """Whether it wants log lines."""

    @property
    def viewing(self) -> Viewing:
        return Viewing(self.looking, lambda picture: self.outbox.put("picture", picture))


class Cockpit:
    """Everything that viewers share. Use `run` beside the server."""

    def __init__(self, node: Node, config: CockpitConfig) -> None:
        self.node = node
        self.config = config
        self.levels = levels(config.jpeg_quality)
        self.scene = Scene(node.robot)
        self.viewers: set[Viewer] = set()
        self.stopper = Stopper(node, lambda told: self.tell_all("stopped", told))
        self.asker = Asker(node)
        self.pictures = Pictures(config.fps, self._marks, self._now_ns, threaded=not node.clock.virtual)
        self.shelf = Shelf(None if config.folder is None else Path(config.folder))
        self._log = LogLines(*private.log_folder(node.robot_name, private.default_run_dir() / node.robot_name))
        self._recent: deque[dict[str, Any]] = deque(maxlen=FIRST_LINES)
        self._disk = None if node.clock.virtual else ThreadPoolExecutor(2, "disk")
        self._feed = Feed(node, self._take, self._take_frame)
        self._told_floor: FloorPlan | None = None
        self._looked_at = asyncio.Event()
        node.watch_alive(self._on_alive)

    # --- viewers ----------------------------------------------------------------------------------

    def enter(self, visitor: Visitor) -> Viewer:
        """Let a visitor look."""
        viewer = Viewer(Looking(self.levels), visitor)
        self.viewers.add(viewer)
        self.attend()
        if (floor := self.scene.map()) is not None:
            viewer.outbox.put("map", encoded(floor))
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """A viewer has gone."""
        self.viewers.discard(viewer)
        self.attend()

    def attend(self) -> None:
        """Hear of the mesh what the viewers look at now."""
        self._feed.use(bool(self.viewers), any(viewer.looking.on for viewer in self.viewers))
        if self.viewers:
            self._looked_at.set()
        else:
            self._looked_at.clear()

    def tell_all(self, kind: Kind, message: dict[str, Any]) -> None:
        """Send something to every viewer."""
        text = encoded(message)
        for viewer in self.viewers:
            viewer.outbox.put(kind, text)

    # --- the mesh ---------------------------------------------------------------------------------

    def _take(self, topic: Topic[Any], message: Message) -> None:
        self.scene.take(topic, message)
        if isinstance(message, FloorPlan) and not self._told(message):
            self._told_floor = message
            if (floor := self.scene.map()) is not None:
                self.tell_all("map", floor)

    def _told(self, floor: FloorPlan) -> bool:
        """Whether the viewers have this map already."""
        told = self._told_floor
        return told is not None and all(getattr(told, name) == getattr(floor, name) for name in SHOWN_OF_FLOOR)

    def _take_frame(self, frame: Frame) -> None:
        self.pictures.take(frame, [viewer.viewing for viewer in self.viewers])

    def _on_alive(self, service: str, alive: bool) -> None:
        self.scene.lives(service, alive)
        self.stopper.lives(service, alive)
        self.asker.lives(service, alive)
        if service == "executive" and alive:
            self.node.spawn(self._greet_all())

    async def _greet_all(self) -> None:
        """Tell the viewers of the tasks and objects of an executive that has just come."""
        if self.viewers:
            await self.asker.learn()
            for viewer in self.viewers:
                viewer.outbox.put("hello", encoded(self.hello(viewer)))

    def _marks(self, stamp_ns: int, width: int, height: int) -> dict[str, Any]:
        return self.scene.marks(stamp_ns, width, height)

    def _now_ns(self) -> int:
        return self.node.clock.latest_ns() or 0

    # --- the disk ---------------------------------------------------------------------------------

    async def beside(self, work: Callable[[], T]) -> T:
        """Work that waits for the disk, in a thread of its own; in virtual time, which knows no threads, here."""
        if self._disk is None:
            return work()
        return await asyncio.get_running_loop().run_in_executor(self._disk, work)

    async def written(self) -> list[str]:
        """The captures that recorders write now."""
        told = await self.node.newest(RECORDING.of(ANY), WRITTEN_S)
        return [recording.file for recording in told if recording.file and not recording.ended]

    def want_log(self, viewer: Viewer, on: bool) -> None:
        """Send a viewer the newest lines of the log and those to come, or no more."""
        if on and not viewer.log:
            viewer.outbox.log(self._recent)
        viewer.log = on

    async def tell_log(self) -> None:
        """Send new lines of the log to those who want them, for ever."""
        while True:
            await self._looked_at.wait()
            wanting = [viewer for viewer in self.viewers if viewer.log]
            lines = await self.beside(self._log.take) if wanting else []
            self._recent.extend(lines)
            if lines:
                for viewer in wanting:
                    viewer.outbox.log(lines)
            await asyncio.sleep(LOG_S)

    # --- telling ----------------------------------------------------------------------------------

    def hello(self, viewer: Viewer) -> dict[str, Any]:
        """What a page has to know of the robot."""
        robot = self.node.robot
        speed_mps = robot.base.max_wheel_speed_mps
        turn_radps = round(speed_mps / robot.drive.lever_m, 3)
        # A robot without a neck turns to look about.
        looks_radps = [robot.joints[name].max_speed_radps for name in robot.head_joints] or [turn_radps, 0.0]
        return {
            "kind": "hello",
            "robot": self.node.robot_name,
            "role": viewer.visitor.role,
            "live": True,
            "tasks": self.asker.tasks,
            "objects": self.asker.objects,
            "body": {"radius_m": robot.base.chassis_diameter_m / 2},
            "limits": {
                "speed_mps": speed_mps,
                "turn_radps": turn_radps,
                "pan_radps": looks_radps[0],
                "tilt_radps": looks_radps[1],
            },
            "fps": self.config.fps,
        }

    async def run(self) -> None:
        """Tell the state to all viewers, for ever."""
        self.node.spawn(self.tell_log())
        while True:
            await self._looked_at.wait()
            self.tell_all("state", self.scene.state(self._now_ns()))
            await asyncio.sleep(1.0 / STATE_HZ)
