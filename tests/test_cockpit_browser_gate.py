"""A real browser at the cockpit's gate: pages of others reach nothing, and the cockpit's own page works behind it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from browser_rig import browser
from cockpit_access_rig import Echo, Open, served
from playwright.sync_api import Browser, Page

from services.cockpit.access import Receive, Send
from services.cockpit.access_rules import Scope
from services.cockpit.page_files import INDEX, PageFiles

pytestmark = [pytest.mark.process, pytest.mark.zenoh]

ATTACK = """
async ([url, socketUrl]) => {
  const said = [];
  const attempt = async (name, what) => {
    try { said.push([name, await what()]); } catch (error) { said.push([name, "refused"]); }
  };
  await attempt("post", () => fetch(url + "stop", {method: "POST", mode: "no-cors"}).then(a => a.type));
  await attempt("json", () => fetch(url + "captures/clean", {method: "POST", body: "{}",
    headers: {"Content-Type": "application/json"}}).then(a => a.status));
  await attempt("read", () => fetch(url + "captures").then(a => a.text()));
  await attempt("beacon", async () => navigator.sendBeacon(url + "stop"));
  await attempt("socket", () => new Promise((yes, no) => {
    const socket = new WebSocket(socketUrl);
    socket.onopen = () => { socket.send('{"do":"stop"}'); yes("open"); };
    socket.onerror = no;
  }));
  await attempt("script", () => new Promise((yes, no) => {
    const script = document.createElement("script");
    script.src = url + "static/js/main.js"; script.onload = () => yes("loaded"); script.onerror = no;
    document.body.append(script);
  }));
  await attempt("form", () => new Promise((yes) => {
    const frame = document.createElement("iframe"); frame.name = "hidden"; frame.onload = () => yes("sent");
    const form = document.createElement("form"); form.method = "post"; form.target = "hidden";
    form.action = url + "captures/clean";
    document.body.append(frame, form); form.submit();
  }));
  return said;
}
"""


class Pages(Echo):
    """An echo that has the files of the page, too."""

    def __init__(self) -> None:
        super().__init__()
        self._files = PageFiles()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope["path"]
        if scope["type"] == "http" and (path == "/" or path.startswith("/static/")):
            await self._files.response(INDEX if path == "/" else path.removeprefix("/static/"))(scope, receive, send)
            return
        await super().__call__(scope, receive, send)


@contextmanager
def cockpit() -> Iterator[Open]:
    """A cockpit in a thread of its own."""
    found: list[tuple[Open, asyncio.AbstractEventLoop, asyncio.Event]] = []
    begun = threading.Event()

    async def serve() -> None:
        over = asyncio.Event()
        async with served(echo=Pages()) as opened:
            found.append((opened, asyncio.get_running_loop(), over))
            begun.set()
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    assert begun.wait(60.0)
    opened, loop, over = found[0]
    try:
        yield opened
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()


@contextmanager
def foreign_page() -> Iterator[str]:
    """The address of a page of somebody else."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>x</title><body></body>")

        def log_message(self, *_: Any) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser("--host-resolver-rules=MAP evil.example 127.0.0.1") as started:
        yield started


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    context = chromium.new_context()
    yield context.new_page()
    context.close()


def test_a_page_of_somebody_else_reaches_nothing(page: Page) -> None:
    with cockpit() as opened, foreign_page() as foreign:
        page.goto(foreign)
        url = f"http://127.0.0.1:{opened.port}/"
        said = dict(page.evaluate(ATTACK, [url, f"ws://127.0.0.1:{opened.port}/live"]))
        assert {name: said[name] for name in ("json", "read", "socket", "script")} == dict.fromkeys(
            ("json", "read", "socket", "script"), "refused"
        )
        assert opened.echo.asked == []
        assert opened.echo.messages == []
        assert opened.audit.has("foreign origin", "POST /stop")


def test_a_name_that_leads_here_shows_nothing(page: Page) -> None:
    with cockpit() as opened:
        answer = page.goto(f"http://evil.example:{opened.port}/")
        assert answer is not None
        assert answer.status == 421
        assert opened.audit.has("foreign host")


def test_the_cockpits_own_page_breaks_none_of_its_rules(page: Page) -> None:
    complaints: list[str] = []
    page.on("console", lambda told: complaints.append(told.text))
    with cockpit() as opened:
        with page.expect_websocket() as socket:
            page.goto(f"http://127.0.0.1:{opened.port}/")
        assert "/live" in socket.value.url
        page.wait_for_function("() => performance.getEntriesByType('resource').length > 15")
        assert page.evaluate("() => fetch('/stop', {method: 'POST'}).then(answer => answer.status)") == 200
        assert "POST /stop" in opened.echo.asked
        assert opened.audit.refusals == 0, opened.audit.lines
    rules = ("Content Security Policy", "Permissions-Policy", "Refused")
    assert not [text for text in complaints if any(rule in text for rule in rules)], complaints
