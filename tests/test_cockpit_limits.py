"""Visitors of the cockpit who want too much, too often or for too long: what they meet, and that a STOP passes."""

from __future__ import annotations

import asyncio

import pytest
from cockpit_access_rig import ask, head, speak
from test_cockpit_gate import OWN, VIEWER, Rig

from cocoro.testing import in_virtual_time
from services.cockpit.access import GateLimits, Message, Receive, Send
from services.cockpit.access_limits import Audit, Budgets, Rate
from services.cockpit.access_passage import Passage
from services.cockpit.access_rules import Scope


@in_virtual_time
async def test_requests_beyond_a_visitors_budget_are_refused_until_time_has_passed() -> None:
    rig = Rig(GateLimits(requests=Rate(1.0, 3.0)))
    for _ in range(3):
        assert (await ask(rig.app, head())).status == 200
    rig.echo.asked.clear()
    answer = await rig.refused(429, "too many requests")
    assert answer.headers["retry-after"] == "1"
    rig.now_s += 1.0
    assert (await ask(rig.app, head())).status == 200


@in_virtual_time
async def test_a_stop_has_a_budget_of_its_own() -> None:
    rig = Rig(GateLimits(requests=Rate(1.0, 1.0), stops=Rate(1.0, 2.0)))
    for _ in range(5):
        await ask(rig.app, head())
    for status in (200, 200, 429):
        assert (await ask(rig.app, head("POST", "/stop", [OWN]))).status == status


@in_virtual_time
async def test_one_address_does_not_use_up_anothers_budget() -> None:
    rig = Rig(GateLimits(requests=Rate(1.0, 1.0)), visitor=None)
    for status in (401, 429, 429):
        assert (await ask(rig.app, head(client=("10.0.0.5", 1)))).status == status
    assert (await ask(rig.app, head(client=("10.0.0.6", 1)))).status == 401


@in_virtual_time
async def test_those_who_are_nobody_use_up_no_visitors_budget() -> None:
    rig = Rig(visitor=None)
    statuses = {(await ask(rig.app, head(client=(f"10.0.0.{number}", 1)))).status for number in range(200)}
    assert statuses == {401, 503}
    rig.gate.visitor = VIEWER
    assert (await ask(rig.app, head())).status == 200


@in_virtual_time
async def test_stops_that_a_foreign_page_sends_use_up_nobodys_budget() -> None:
    rig = Rig()
    for _ in range(100):
        await ask(rig.app, head("POST", "/stop", [("Origin", "http://evil.example")]))
    assert (await ask(rig.app, head("POST", "/stop", [OWN]))).status == 200


@in_virtual_time
async def test_a_stop_is_one_whatever_comes_with_it() -> None:
    rows = [OWN, ("Content-Type", "text/plain"), ("Content-Length", "4")]
    assert (await ask(Rig().app, head("POST", "/stop", rows), b"stop")).status == 200


@in_virtual_time
async def test_messages_that_are_too_many_too_long_or_no_text_end_their_socket() -> None:
    wrong: dict[int, list[Message | str]] = {
        1008: ["x"] * 300,
        1009: ["x" * (64 * 1024 + 1)],
        1003: [{"type": "websocket.receive", "bytes": b"\0\1"}],
    }
    for code, messages in wrong.items():
        rig = Rig()
        spoken = await speak(rig.app, head(path="/live", headers=[OWN], scheme="ws"), [*messages, "after"])
        assert spoken.code == code
        assert rig.audit.has(spoken.reason)
        assert "after" not in rig.echo.messages
        assert not rig.gate.sockets


@in_virtual_time
async def test_a_stop_passes_where_the_sockets_messages_are_used_up() -> None:
    rig = Rig()
    stop = '{"do":"stop","id":1}'
    spoken = await speak(rig.app, head(path="/live", headers=[OWN], scheme="ws"), ["x"] * 200 + [stop, "x", stop])
    assert rig.echo.messages.count(stop) == 1
    assert spoken.code == 1008


@in_virtual_time
async def test_stops_alone_may_not_flood_either() -> None:
    rig = Rig()
    stop = '{"do":"stop","id":1}'
    spoken = await speak(rig.app, head(path="/live", headers=[OWN], scheme="ws"), [stop] * 500)
    assert len(rig.echo.messages) == 210
    assert spoken.code == 1008


@in_virtual_time
async def test_sockets_beyond_a_visitors_number_are_refused() -> None:
    rig, over = Rig(GateLimits(sockets=2)), asyncio.Event()

    async def waiting() -> Message:
        await over.wait()
        return {"type": "websocket.disconnect", "code": 1000}

    async def send(_message: Message) -> None: ...

    scope = head(path="/live", headers=[OWN], scheme="ws")

    async def hold() -> None:
        first = True

        async def receive() -> Message:
            nonlocal first
            if first:
                first = False
                return {"type": "websocket.connect"}
            return await waiting()

        await rig.app(dict(scope), receive, send)

    held = [asyncio.create_task(hold()) for _ in range(2)]
    await asyncio.sleep(0.1)
    assert not (await speak(rig.app, dict(scope), ["hello"])).accepted
    assert rig.audit.has("too many sockets")
    over.set()
    await asyncio.gather(*held)
    assert (await speak(rig.app, dict(scope), ["hello"])).accepted


@in_virtual_time
async def test_sockets_that_are_opened_again_and_again_are_refused_until_time_has_passed() -> None:
    rig = Rig(GateLimits(openings=Rate(1.0, 3.0)))
    scope = head(path="/live", headers=[OWN], scheme="ws")
    opened = [(await speak(rig.app, dict(scope), ["hello"])).accepted for _ in range(5)]
    assert opened == [True] * 3 + [False] * 2
    assert rig.audit.has("too many new sockets")
    rig.now_s += 1.0
    assert (await speak(rig.app, dict(scope), ["hello"])).accepted


@in_virtual_time
async def test_a_socket_ends_with_its_visitors_session() -> None:
    rig = Rig(visitor=VIEWER)

    app = Passage(rig.gate, rig.echo)

    async def hurrying(scope: Scope, receive: Receive, send: Send) -> None:
        async def later() -> Message:
            message = await receive()
            if message.get("text") == "end":
                rig.gate.visitor, rig.now_s = None, rig.now_s + 2.0
            return message

        await app(scope, later, send)

    spoken = await speak(hurrying, head(path="/live", headers=[OWN], scheme="ws"), ["hello", "end", "after"])
    assert spoken.code == 4401
    assert rig.echo.messages == ["hello"]


# --- the log ---------------------------------------------------------------------------------------------


def test_a_flood_of_refusals_is_few_lines_with_their_number(caplog: pytest.LogCaptureFixture) -> None:
    now_s = 0.0
    audit = Audit(lambda: now_s, every_s=10.0)
    for _ in range(1000):
        audit.refused("10.0.0.5", "foreign host", "GET /")
    assert [record.message for record in caplog.records] == ["refused: 10.0.0.5: foreign host (GET /)"]
    now_s = 10.0
    audit.tell()
    assert "998 times more" in caplog.records[-1].message
    audit.refused("10.0.0.6", "foreign host")
    assert len(caplog.records) == 3
    assert audit.refusals == 1001


def test_a_flood_of_clients_is_few_lines(caplog: pytest.LogCaptureFixture) -> None:
    now_s = 0.0
    audit = Audit(lambda: now_s, kinds=16)
    for number in range(1000):
        audit.refused(f"10.0.{number // 256}.{number % 256}", "foreign host")
    assert len(caplog.records) <= 17
    now_s = 10.0
    audit.tell()
    assert "too many clients" in caplog.records[-1].message


def test_what_a_client_sends_cannot_forge_a_line(caplog: pytest.LogCaptureFixture) -> None:
    Audit(lambda: 0.0).refused("10.0.0.5", "bad path", "GET /a\r\n2026-12-01 refused: nobody\x1b[2J\u202e" + "x" * 500)
    (record,) = caplog.records
    assert "\n" not in record.message
    assert record.message.isprintable()
    assert len(record.message) < 300


def test_a_budget_is_forgotten_when_it_is_full_and_the_others_are_kept() -> None:
    now_s = 0.0
    budgets = Budgets(Rate(1.0, 2.0), lambda: now_s, keys=4)
    assert [budgets.take("one") for _ in range(3)] == [True, True, False]
    for key in "abc":
        budgets.take(key)
    now_s = 1.5
    budgets.take("new")  # a, b and c are full again
    assert [budgets.take("one") for _ in range(2)] == [True, False]
