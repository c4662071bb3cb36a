"""A server that speaks the cockpit's protocol about a made-up robot, for the page's tests and for work on the page.

`python tests/cockpit_fake.py 8780` serves it on that port.
"""

from __future__ import annotations

import asyncio
import json
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import uvicorn
from cockpit_world import HEIGHT, OBJECTS, TASKS, WIDTH, World, captures
from operator_shell import PATIENCE_S
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

PAGE = Path(__file__).parent.parent / "services" / "cockpit" / "page"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; manifest-src 'self';"
    " base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
FPS = 8.0
LINE = {"level": "info", "service": "planning", "text": "drives around the box"}
LINES: list[dict[str, Any]] = [{}, {"level": "warning", "service": "perception", "text": "a frame was late: 140 ms"}]
GONE = (WebSocketDisconnect, RuntimeError)
"""What sending to a page raises that is closed."""
PLAYED_S = 31.5
MARKS = [
    {"at_s": 0.4, "kind": "task", "text": "fetch red can"},
    {"at_s": 6.0, "kind": "phase", "text": "approach"},
    {"at_s": 19.0, "kind": "phase", "text": "reach"},
    {"at_s": 23.5, "kind": "fault", "text": "a frame was late"},
    {"at_s": 29.0, "kind": "stop", "text": "stopped"},
]


class Strict:
    """Adds the policy under which the page must work."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], (b"content-security-policy", POLICY.encode())]
            await send(message)

        await self.app(scope, receive, sending)


class Viewer:
    """One socket: what goes to it, and the pictures that it has not acknowledged."""

    def __init__(self, fake: FakeCockpit, socket: WebSocket, capture: str = "") -> None:
        self.fake = fake
        self.socket = socket
        self.capture = capture
        self.pictures = True
        self.seen = asyncio.Event()
        self.seen.set()
        self.played: dict[str, Any] = {"at_s": 0.0, "duration_s": PLAYED_S, "paused": False, "speed": 1.0}

    async def send(self, kind: str, **content: Any) -> None:
        await self.socket.send_text(json.dumps({"kind": kind, **content}))

    async def serve(self) -> None:
        await self.socket.accept()
        await self.send("hello", **self.fake.hello(live=not self.capture))
        async with asyncio.TaskGroup() as tasks:
            told = [tasks.create_task(each) for each in (self._states(), self._maps(), self._pictures())]
            with suppress(WebSocketDisconnect):
                while True:
                    await self.take(json.loads(await self.socket.receive_text()))
            for each in told:
                each.cancel()

    async def take(self, message: dict[str, Any]) -> None:
        do, world = message["do"], self.fake.world
        self.fake.note(message)
        if do == "seen":
            self.seen.set()
        elif do == "pictures":
            self.pictures = message["on"]
        elif do == "drive":
            if self.fake.answers:
                await self.send("tick", **world.drive(message["tick"], message["motion"]))
        elif do == "stop":
            await self.fake.stop()
        elif do == "log" and message["on"]:
            await self.send("log", lines=[LINE | {"t_ns": time.time_ns(), **line} for line in LINES * 6])
        elif do in ("seek", "pause", "speed"):
            name, value = {"seek": ("at_s", "at_s"), "pause": ("paused", "on"), "speed": ("speed", "x")}[do]
            self.played[name] = message[value]
            await self.send("played", **self.played, marks=MARKS)
        elif "id" in message:
            await self.send("reply", id=message["id"], **self.fake.answer(message))
            if do == "begin-drive" and world.drives:
                await self.send("tick", **world.drive(0, {}))

    async def _states(self) -> None:
        while True:
            await self.socket.send_text(json.dumps(self.fake.world.state()))
            if self.capture:
                if not self.played["paused"]:
                    self.played["at_s"] = (self.played["at_s"] + 0.1 * self.played["speed"]) % PLAYED_S
                await self.send("played", **self.played, marks=MARKS)
            await asyncio.sleep(0.1)

    async def _maps(self) -> None:
        while True:
            await self.socket.send_text(json.dumps(self.fake.world.map()))
            await asyncio.sleep(0.5)

    async def _pictures(self) -> None:
        while True:
            await self.seen.wait()
            if self.pictures and self.fake.sees:
                self.seen.clear()
                stamp_ns = time.time_ns()
                self.fake.stamps.append(stamp_ns)
                marks, jpeg = self.fake.world.picture()
                header = {
                    "stamp_ns": stamp_ns, "now_ns": time.time_ns(), "width": WIDTH, "height": HEIGHT,
                    "level": "1/80", "marks": marks,
                }  # fmt: skip
                text = json.dumps(header).encode()
                await self.socket.send_bytes(struct.pack("<I", len(text)) + text + jpeg)
            await asyncio.sleep(1 / FPS)


class FakeCockpit:
    """`with FakeCockpit() as fake:` serves the page at `fake.url` from a thread of its own."""

    def __init__(self, *, port: int = 0, role: str = "operator") -> None:
        self.world = World()
        self.role = role
        self.asked: list[dict[str, Any]] = []
        """All messages of all pages, in their order; a request that changes something is one, too."""
        self.stamps: list[int] = []
        """Of the pictures that went out."""
        self.stops = True
        """Whether a stop is acknowledged."""
        self.sees = True
        """Whether pictures come."""
        self.answers = True
        """Whether motions are answered."""
        self._viewers: set[Viewer] = set()
        self._news = threading.Condition()
        routes = [
            Route("/", self._page),
            Mount("/static", StaticFiles(directory=PAGE)),
            Route("/stop", self._stop, methods=["POST"]),
            Route("/health", self._health),
            Route("/captures", self._captures),
            Route("/captures/{rest:path}", self._change, methods=["GET", "POST", "DELETE"]),
            WebSocketRoute("/live", self._live),
            WebSocketRoute("/play", self._play),
        ]
        app = Starlette(routes=routes, middleware=[Middleware(Strict)])
        config = uvicorn.Config(
            app, host="127.0.0.1", port=port, log_level="error", ws="websockets-sansio", lifespan="off"
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        while not self._server.started:
            self._thread.join(0.01)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the server, as a service does that is killed."""
        self._server.should_exit = self._server.force_exit = True
        self._thread.join()

    @property
    def url(self) -> str:
        host, port = self._server.servers[0].sockets[0].getsockname()[:2]
        return f"http://{host}:{port}/"

    def note(self, message: dict[str, Any]) -> None:
        """A page has sent this."""
        with self._news:
            self.asked.append(message)
            self._news.notify_all()

    def until(self, met: Callable[[], object]) -> None:
        """Wait until that is so; it is looked at whenever a page sends something."""
        with self._news:
            assert self._news.wait_for(met, PATIENCE_S), f"not within {PATIENCE_S:g} s; last: {self.asked[-5:]}"

    def done(self, do: str) -> list[dict[str, Any]]:
        """The messages of that kind that pages have sent."""
        return [message for message in list(self.asked) if message["do"] == do]

    def hello(self, *, live: bool) -> dict[str, Any]:
        return {
            "robot": "calliope",
            "role": self.role,
            "live": live,
            "tasks": TASKS,
            "objects": OBJECTS,
            "body": {"radius_m": 0.17},
            "limits": {"speed_mps": 0.35, "turn_radps": 1.5},
            "fps": FPS,
        }

    def answer(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """The reply to a request of a page."""
        world, ok, text, data = self.world, True, "", None
        match message["do"]:
            case "run":
                ok, text = world.begin(message["task"], message["instead"])
            case "cancel":
                world.end("cancelled", "cancelled: by the operator")
            case "reset":
                world.latch = "released"
            case "begin-drive":
                ok, text = world.begin({"task": "drive"}, message["instead"])
                world.drives = ok
            case "end-drive":
                world.end("done")
            case "what":
                data = self._what(message)
        return {"ok": ok, "text": text, **({} if data is None else {"data": data})}

    def _what(self, message: Mapping[str, Any]) -> dict[str, Any]:
        if "map" in message:
            x_m, y_m = message["map"]
            away_m = ((x_m - self.world.x_m) ** 2 + (y_m - self.world.y_m) ** 2) ** 0.5
            return {"label": None, "place": [x_m, y_m], "text": f"{away_m:.1f} m away"}
        at = message["picture"]
        for mark in self.world.seen():
            left, top, right, bottom = mark["box"]
            if left - 4 <= at["u"] <= right + 4 and top - 4 <= at["v"] <= bottom + 4:
                return {"label": mark["label"], "place": None, "text": "1.6 m away"}
        return {"label": None, "place": [1.0, 0.2], "text": "1.0 m away"}

    async def stop(self) -> dict[str, Any]:
        if not self.stops:
            return {"acknowledged": [], "missing": [], "ms": 0.0}
        self.world.latch = "latched"
        self.world.end("cancelled", "cancelled: the robot was stopped")
        answer = {"acknowledged": ["base", "servos", "executive"], "missing": [], "ms": 4.2}
        for viewer in list(self._viewers):
            with suppress(*GONE):
                await viewer.send("stopped", **answer)
        return answer

    async def _page(self, _: Request) -> Response:
        return FileResponse(PAGE / "index.html")

    async def _stop(self, request: Request) -> Response:
        self.note({"do": "posted", "path": request.url.path})
        return JSONResponse(await self.stop())

    async def _health(self, _: Request) -> Response:
        return JSONResponse({"robot": "calliope"})

    async def _captures(self, _: Request) -> Response:
        return JSONResponse({"captures": captures()})

    async def _change(self, request: Request) -> Response:
        self.note({"do": request.method.lower(), "path": request.url.path})
        return JSONResponse({"ok": True})

    async def _live(self, socket: WebSocket) -> None:
        await self._serve(Viewer(self, socket))

    async def _play(self, socket: WebSocket) -> None:
        await self._serve(Viewer(self, socket, socket.query_params["capture"]))

    async def _serve(self, viewer: Viewer) -> None:
        self._viewers.add(viewer)
        try:
            await viewer.serve()
        except* GONE:
            pass  # the page was closed while something went to it
        finally:
            self._viewers.discard(viewer)


if __name__ == "__main__":
    with FakeCockpit(port=int(sys.argv[1])) as served:
        print(served.url, flush=True)
        threading.Event().wait()
