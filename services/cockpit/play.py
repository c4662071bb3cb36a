"""The WebSocket of a page that plays a capture. It speaks as the live one does, and operates nothing but the stop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from starlette.websockets import WebSocket

from services.cockpit.access import Gate, Visitor
from services.cockpit.asking import Reply
from services.cockpit.cockpit import Cockpit
from services.cockpit.orders import Look, Pause, Seek, Seen, Speed, Stop, What, play_decoder
from services.cockpit.outbox import Outbox
from services.cockpit.pictures import Looking, Pictures, Viewing
from services.cockpit.playing import Playback
from services.cockpit.pointing import what
from services.cockpit.scene import encoded
from services.cockpit.socket_talk import reply_text, spoken, stop_reply

T = TypeVar("T")

STEP_S = 1 / 30
"""Period in which messages are taken."""
AT_ONCE = 8
"""Questions of the page that may wait."""
TOLD_EVERY = 3
"""Steps from one state to the next."""


class PlaySocket:
    """One connection that plays one capture."""

    def __init__(self, cockpit: Cockpit, socket: WebSocket, gate: Gate, visitor: Visitor, path: Path) -> None:
        self._cockpit = cockpit
        self._socket = socket
        self._gate = gate
        self._visitor = visitor
        self._path = path
        self._outbox = Outbox()
        self._looking = Looking(cockpit.levels)
        self._thread = None if cockpit.node.clock.virtual else ThreadPoolExecutor(1, "playing")
        self._asked: list[What] = []
        self._wanted: Seek | None = None
        """Where to go; only the newest counts."""
        self._paused: bool | None = None
        self._speed: float | None = None

    async def run(self) -> None:
        """Play until one of both ends the connection. Raises CaptureError, before the connection is accepted, for a
        file that cannot be read."""
        playback = await self._beside(lambda: Playback(self._path))
        try:
            await self._socket.accept()
            await self._play(playback)
        finally:
            await self._beside(playback.close)
            if self._thread is not None:
                self._thread.shutdown(wait=False)

    async def _play(self, playback: Playback) -> None:
        pictures = Pictures(
            self._cockpit.config.fps,
            lambda *picture: playback.scene.marks(*picture),
            lambda: playback.now_ns,
            threaded=self._thread is not None,
        )
        self._outbox.put("hello", encoded(self._hello(playback)))
        working = [
            asyncio.ensure_future(self._outbox.run(self._send)),
            asyncio.ensure_future(self._step(playback, pictures)),
        ]
        try:
            while (order := await spoken(self._socket, play_decoder())) is not None:
                self._obey(order)
        finally:
            for task in working:
                task.cancel()
            await asyncio.gather(*working, return_exceptions=True)
            pictures.close()

    async def _send(self, message: str | bytes) -> None:
        await self._socket.send({"type": "websocket.send", "text" if isinstance(message, str) else "bytes": message})

    def _obey(self, order: Stop | What | Seen | Look | Seek | Pause | Speed) -> None:
        if isinstance(order, Stop):  # of the robot itself: it has to work wherever somebody looks
            if self._gate.allows(self._visitor, "stop"):
                stopping = self._cockpit.stopper.stop(self._visitor.name)
                stopping.add_done_callback(lambda done: self._answer_stop(order, done))
        elif isinstance(order, Seen):
            self._looking.seen(order.stamp_ns, asyncio.get_running_loop().time())
        elif isinstance(order, Look):
            self._looking.on = order.on
        elif isinstance(order, Seek):
            self._wanted = order
        elif isinstance(order, Pause):
            self._paused = order.on
        elif isinstance(order, Speed):
            self._speed = order.x
        elif len(self._asked) < AT_ONCE:
            self._asked.append(order)
        else:
            self._outbox.reply(reply_text(order.id, Reply(False, f"{AT_ONCE} questions wait already")))

    def _answer_stop(self, order: Stop, done: asyncio.Task[dict[str, Any]]) -> None:
        if not done.cancelled():
            self._outbox.reply(stop_reply(order.id, done.result()))

    async def _step(self, playback: Playback, pictures: Pictures) -> None:
        loop = asyncio.get_running_loop()
        viewing = Viewing(self._looking, lambda picture: self._outbox.put("picture", picture))
        shown, count = None, 0
        marks: dict[str, Any] = {"marks": [mark._asdict() for mark in playback.marks]}
        while True:
            await self._beside(lambda: self._go_on(playback, loop.time()))
            frame = playback.frame
            # What the file's thread writes is read only while that rests.
            if frame is not None and frame is not shown:
                encoding = pictures.take(frame, [viewing], at_once=playback.paused)
                if encoding is not None:
                    shown = frame
                    await encoding
            for order in self._asked:
                self._outbox.reply(reply_text(order.id, what(order, playback.scene)))
            self._asked.clear()
            if count % TOLD_EVERY == 0:
                self._outbox.put("state", encoded(playback.scene.state(playback.now_ns)))
                self._outbox.put("played", encoded(self._played(playback) | marks))
            count += 1
            await asyncio.sleep(STEP_S if not playback.paused else TOLD_EVERY * STEP_S)

    def _go_on(self, playback: Playback, now_s: float) -> None:
        """In the thread of the file: what was asked for, then what is due."""
        if (speed := self._speed) is not None:
            self._speed = None
            playback.speed(now_s, speed)
        if (paused := self._paused) is not None:
            self._paused = None
            playback.pause(now_s, paused)
        if (wanted := self._wanted) is not None:
            self._wanted = None
            playback.seek(now_s, wanted.at_s)
        playback.step(now_s)

    async def _beside(self, work: Callable[[], T]) -> T:
        """Work on the file in its own thread; in virtual time, which knows no threads, here."""
        if self._thread is None:
            return work()
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    def _played(self, playback: Playback) -> dict[str, Any]:
        return {
            "kind": "played",
            "at_s": round(playback.at_s, 3),
            "duration_s": playback.duration_s,
            "paused": playback.paused,
            "ended": playback.ended,
            "speed": playback.rate,
        }

    def _hello(self, playback: Playback) -> dict[str, Any]:
        robot = playback.robot
        return {
            "kind": "hello",
            "robot": playback.capture.robot,
            "role": self._visitor.role,
            "live": False,
            "capture": self._path.name.removesuffix(".mcap"),
            "tasks": [],
            "objects": [],
            "body": {"radius_m": robot.base.chassis_diameter_m / 2},
            "limits": {},
            "fps": self._cockpit.config.fps,
        }
