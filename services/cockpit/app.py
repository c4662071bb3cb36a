"""The addresses of the cockpit: its page, its WebSockets, and what scripts ask for."""

from __future__ import annotations

from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from services.cockpit.access import Doing, Gate, Visitor
from services.cockpit.cockpit import Cockpit
from services.cockpit.live import LiveSocket, stop_text
from services.cockpit.page_files import INDEX, PageFiles

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
            WebSocketRoute("/live", self._live),
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
        good = bool(told["acknowledged"]) and not told["missing"]
        return JSONResponse(told | {"ok": good, "text": stop_text(told)}, 200 if good else 502)

    # --- sockets ----------------------------------------------------------------------------------

    async def _live(self, socket: WebSocket) -> None:
        visitor = self._visitor(socket.scope, "look")
        if visitor is None:
            await socket.close(NOT_LET_IN, "not let in: log in first")
            return
        await LiveSocket(self._cockpit, socket, self._gate, visitor).run()

    def _visitor(self, scope: Any, doing: Doing) -> Visitor | None:
        """Who asks, if he may do that."""
        visitor = self._gate.who(scope)
        return visitor if visitor is not None and self._gate.allows(visitor, doing) else None


def _refusal() -> Response:
    return PlainTextResponse("not allowed: log in, or ask for the role of an operator\n", 403)
