"""The addresses of the cockpit: its page, its WebSockets, and what scripts ask for."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from cocoro.errors import CocoroError
from services.cockpit.access import Doing, Gate, Visitor
from services.cockpit.cockpit import Cockpit
from services.cockpit.live import LiveSocket
from services.cockpit.page_files import INDEX, PageFiles
from services.cockpit.play import PlaySocket
from services.cockpit.shelf import NoCaptureError, Rule, Shelf
from services.cockpit.socket_talk import REASON_BYTES, stop_text, stopped

NOT_THERE = 4404
"""The code with which a connection is closed that wants a capture that is not there, or cannot be read."""
NOT_LET_IN = 1008
"""The code with which a connection is closed whose visitor is not let in."""


class App:
    """Answers requests; `asgi` is the application."""

    def __init__(self, cockpit: Cockpit, gate: Gate) -> None:
        self._cockpit = cockpit
        self._gate = gate
        self._files = PageFiles()
        self.asgi = Starlette(routes=self._routes())

    def _routes(self) -> list[BaseRoute]:
        return [
            Route("/", self._page),
            Route("/static/{name:path}", self._static),
            Route("/health", self._health),
            Route("/stop", self._stop, methods=["POST"]),
            Route("/captures", self._captures),
            Route("/captures/clean", self._clean, methods=["POST"]),
            Route("/captures/{name}/file", self._download),
            Route("/captures/{name}/{change}", self._pin, methods=["POST"]),
            Route("/captures/{name}", self._delete, methods=["DELETE"]),
            WebSocketRoute("/live", self._live),
            WebSocketRoute("/play", self._play),
        ]

    # --- pages ------------------------------------------------------------------------------------

    async def _page(self, request: Request) -> Response:
        return self._files.response(INDEX)

    async def _static(self, request: Request) -> Response:
        return self._files.response(request.path_params["name"])

    # --- for scripts ------------------------------------------------------------------------------

    async def _health(self, request: Request) -> Response:
        node = self._cockpit.node
        return JSONResponse({"robot": node.robot_name, "viewers": len(self._cockpit.viewers), "state": node.state})

    async def _stop(self, request: Request) -> Response:
        visitor = self._visitor(request.scope, "stop")
        if visitor is None:
            return _refusal()
        told = await self._cockpit.stopper.stop(visitor.name)
        good = stopped(told)
        return JSONResponse(told | {"ok": good, "text": stop_text(told)}, 200 if good else 502)

    # --- captures ---------------------------------------------------------------------------------

    async def _captures(self, request: Request) -> Response:
        if self._visitor(request.scope, "look") is None:
            return _refusal()
        cockpit = self._cockpit
        written = await cockpit.written()
        return JSONResponse({"captures": await cockpit.beside(lambda: cockpit.shelf.listed(written))})

    async def _download(self, request: Request) -> Response:
        if self._visitor(request.scope, "look") is None:
            return _refusal()
        cockpit, name = self._cockpit, request.path_params["name"]
        written = await cockpit.written()
        try:
            path = await cockpit.beside(lambda: cockpit.shelf.find(name, written))
        except CocoroError as error:
            return _answered(error)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    async def _pin(self, request: Request) -> Response:
        name, change = request.path_params["name"], request.path_params["change"]
        if change not in ("pin", "unpin"):
            return PlainTextResponse("a capture can be pinned and unpinned: /captures/NAME/pin\n", 404)
        return await self._change(request, lambda shelf, _: shelf.pin(name, change == "pin"))

    async def _delete(self, request: Request) -> Response:
        name = request.path_params["name"]
        return await self._change(request, lambda shelf, written: shelf.remove(name, written))

    async def _clean(self, request: Request) -> Response:
        try:
            rule = msgspec.json.decode(await request.body(), type=Rule)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            return PlainTextResponse(f"not a rule of what to delete: {error}\n", 400)
        return await self._change(request, lambda shelf, written: shelf.clean(rule, written))

    async def _change(self, request: Request, change: Callable[[Shelf, list[str]], object]) -> Response:
        visitor = self._visitor(request.scope, "operate")
        if visitor is None:
            return _refusal()
        cockpit = self._cockpit
        written = await cockpit.written()
        try:
            done = await cockpit.beside(lambda: change(cockpit.shelf, written))
        except CocoroError as error:
            return _answered(error)
        cockpit.node.log.info("%s by %s: %s", request.url.path, visitor.name, "done" if done is None else done)
        return JSONResponse({"ok": True, "deleted": done} if isinstance(done, list) else {"ok": True})

    # --- sockets ----------------------------------------------------------------------------------

    async def _live(self, socket: WebSocket) -> None:
        visitor = self._visitor(socket.scope, "look")
        if visitor is None:
            await socket.close(NOT_LET_IN, "not let in: log in first")
            return
        await LiveSocket(self._cockpit, socket, self._gate, visitor).run()

    async def _play(self, socket: WebSocket) -> None:
        visitor = self._visitor(socket.scope, "look")
        if visitor is None:
            await socket.close(NOT_LET_IN, "not let in: log in first")
            return
        cockpit, name = self._cockpit, socket.query_params.get("capture", "")
        try:
            written = await cockpit.written()
            path = await cockpit.beside(lambda: cockpit.shelf.find(name, written))
            await PlaySocket(cockpit, socket, self._gate, visitor, path).run()
        except CocoroError as error:
            await socket.accept()  # a browser tells its page no reason before that
            why = re.sub(r"\S*/(?=\S)", "", str(error))  # the files' names without their folders, which fill the reason
            await socket.close(NOT_THERE, why.encode()[:REASON_BYTES].decode(errors="ignore"))

    def _visitor(self, scope: Any, doing: Doing) -> Visitor | None:
        """Who asks, if he may do that."""
        visitor = self._gate.who(scope)
        return visitor if visitor is not None and self._gate.allows(visitor, doing) else None


def _answered(error: CocoroError) -> Response:
    return PlainTextResponse(f"{error}\n", 404 if isinstance(error, NoCaptureError) else 409)


def _refusal() -> Response:
    return PlainTextResponse("not allowed: log in, or ask for the role of an operator\n", 403)
