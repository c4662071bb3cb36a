"""Who is let through the cockpit's gate, and what each hostile request meets: refused, with a reason, and logged."""

from __future__ import annotations

import pytest
from cockpit_access_rig import HOST, Answer, Echo, Fixed, Heard, ask, head, speak

from cocoro.testing import in_virtual_time
from services.cockpit import access_rules as rules
from services.cockpit.access import GateLimits, Message, Visitor
from services.cockpit.access_passage import Passage

OWN = ("Origin", f"http://{HOST}")
JSON = ("Content-Type", "application/json")
VIEWER = Visitor("eve", "viewer", "session 12345678")


class Rig:
    """A gate with a given visitor around an echo, with a clock that is set by hand."""

    def __init__(self, limits: GateLimits | None = None, visitor: Visitor | None = Fixed.visitor) -> None:
        self.now_s = 0.0
        self.audit = Heard(lambda: self.now_s)
        self.gate = Fixed(audit=self.audit, limits=limits, clock=lambda: self.now_s)
        self.gate.visitor = visitor
        self.echo = Echo()
        self.app = Passage(self.gate, self.echo)

    async def refused(self, status: int, what: str, *given: object, **more: object) -> Answer:
        """Asks, and checks that it is refused, that the log says so, and that the service never saw it."""
        body = more.pop("body", b"")
        assert isinstance(body, bytes)
        answer = await ask(self.app, head(*given, **more), body)  # type: ignore[arg-type]
        assert answer.status == status, answer
        assert self.audit.has(what), self.audit.lines
        assert not self.echo.asked
        assert answer.headers["connection"] == "close"
        return answer


# --- where a request comes from ----------------------------------------------------------------------

FOREIGN_ORIGINS = (
    "http://evil.example", "https://127.0.0.1:8770", "http://127.0.0.1:8771", "http://localhost:8770", "null", "",
    "http://127.0.0.1:8770.evil.example", "http://127.0.0.1", "file://", "http://127.0.0.1:8770/",
    "http://evil.example http://127.0.0.1:8770", "chrome-extension://abcdefghijklmnop",
)  # fmt: skip


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
@in_virtual_time
async def test_a_page_of_another_origin_can_send_nothing(origin: str) -> None:
    await Rig().refused(403, "foreign origin", "POST", "/stop", [("Origin", origin)])
    await Rig().refused(403, "foreign origin", "GET", "/captures", [("Origin", origin)])


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
@in_virtual_time
async def test_a_page_of_another_origin_can_open_no_socket(origin: str) -> None:
    rig = Rig()
    spoken = await speak(rig.app, head(path="/live", headers=[("Origin", origin)], scheme="ws"), ['{"do":"stop"}'])
    assert not spoken.accepted
    assert rig.audit.has("foreign origin", "SOCKET /live")
    assert not rig.echo.messages


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none", "rubbish"])
@pytest.mark.parametrize("path", ["/stop", "/captures/clean", "/login"])
@in_virtual_time
async def test_a_form_of_another_site_is_refused_also_without_an_origin(site: str, path: str) -> None:
    form = [("Sec-Fetch-Site", site), ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", "document")]
    kind = ("Content-Type", "application/x-www-form-urlencoded")
    await Rig().refused(403, "foreign origin", "POST", path, [*form, kind], body=b"a=b")


@pytest.mark.parametrize("dest", ["iframe", "frame", "embed", "object", "image", "script", "empty", ""])
@in_virtual_time
async def test_another_site_can_embed_nothing(dest: str) -> None:
    rows = [("Sec-Fetch-Site", "cross-site"), ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", dest)]
    await Rig().refused(403, "foreign origin", "GET", "/", rows)


@pytest.mark.parametrize("kind", ["text/plain", "multipart/form-data; boundary=x", "application/x-www-form-urlencoded"])
@in_virtual_time
async def test_a_body_of_a_type_that_any_form_can_send_is_refused(kind: str) -> None:
    rows = [("Content-Type", kind), ("Content-Length", "9"), OWN]
    await Rig().refused(415, "body's type", "POST", "/captures/clean", rows, body=b'{"a":"b"}')


@in_virtual_time
async def test_a_link_and_a_typed_address_open_the_page() -> None:
    for site in ("none", "cross-site"):
        rows = [("Sec-Fetch-Site", site), ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", "document")]
        assert (await ask(Rig().app, head("GET", "/", rows))).status == 200


@in_virtual_time
async def test_the_page_and_a_script_of_this_machine_may_do_everything() -> None:
    rig = Rig()
    assert (await ask(rig.app, head("POST", "/stop"))).body == b"echo "
    rows = [OWN, JSON, ("Sec-Fetch-Site", "same-origin"), ("Content-Length", "2")]
    assert (await ask(rig.app, head("POST", "/captures/clean", rows), b"{}")).body == b"echo {}"
    assert (await ask(rig.app, head("DELETE", "/captures/one.mcap", [OWN]))).status == 200
    spoken = await speak(rig.app, head(path="/live", headers=[OWN], scheme="ws"), ["hello"])
    assert spoken == (True, 0, "", ["hello"])
    assert rig.audit.refusals == 0


FOREIGN_HOSTS = (
    None, "evil.example", "evil.example:8770", "localhost.evil.example", "127.0.0.1.evil.example", "127.0.0.2", "",
    "0.0.0.0:8770", "2130706433", "127.1", "[::ffff:127.0.0.1]", "user@127.0.0.1", "127.0.0.1:8770:1", "[::1",
    "localhost/", "localhost:port", "xn--lcalhost-21a", "127.0.0.1 evil.example", "192.168.1.5:8770",
)  # fmt: skip


@pytest.mark.parametrize("host", FOREIGN_HOSTS)
@in_virtual_time
async def test_a_name_that_was_made_to_lead_here_is_refused(host: str | None) -> None:
    await Rig().refused(421, "foreign host", "GET", "/", host=host)
    await Rig().refused(421, "foreign host", "POST", "/stop", [("Origin", f"http://{host}")], host=host)


@in_virtual_time
async def test_two_hosts_are_refused() -> None:
    await Rig().refused(421, "foreign host", "GET", "/", [("Host", "evil.example")])


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost:8770", "LOCALHOST", "[::1]:8770", "localhost.", "[0:0::1]"])
@in_virtual_time
async def test_each_name_of_this_machine_is_taken_at_any_port(host: str) -> None:
    assert (await ask(Rig().app, head("GET", "/", host=host))).status == 200


# --- what is asked for ---------------------------------------------------------------------------------

BAD_PATHS = (
    "/captures/../../etc/passwd", "/captures/..", "/captures/%2e%2e/%2e%2e/etc/passwd", "/captures/..%2f..%2fetc",
    "/captures/%252e%252e%252fetc", "/captures/..\\..\\x", "/captures/%5c..%5cx", "/captures/a%00.mcap", "/captures//x",
    "//evil.example/x", "/static/./x", "/captures/%c0%ae%c0%ae/x", "/captures/a%0d%0aSet-Cookie:x/file",
    "/captures/%e2%80%ae/file", "captures", "http://127.0.0.1:8770/", "*", "/" + "a" * 2000,
    "/captures/" + "%61" * 400, "/captures/a%2Fb/file", "/captures/\u0080/file",
)  # fmt: skip


@pytest.mark.parametrize("path", BAD_PATHS)
@in_virtual_time
async def test_a_path_that_could_lead_out_of_a_folder_is_refused(path: str) -> None:
    await Rig().refused(400, "bad path", "GET", path)
    await Rig().refused(400, "bad path", "DELETE", path, [OWN])


@pytest.mark.parametrize("method", ["PUT", "PATCH", "OPTIONS", "TRACE", "CONNECT", "get", "BREW", ""])
@in_virtual_time
async def test_a_method_that_nothing_here_has_is_refused(method: str) -> None:
    await Rig().refused(405, "method", method, "/")


@pytest.mark.parametrize("name", rules.PROXY_HEADERS)
@in_virtual_time
async def test_no_answer_permits_another_origin_to_read_it(name: str) -> None:
    answer = await ask(Rig().app, head("GET", "/", [(name, "10.0.0.5")]))
    assert not [header for header in answer.headers if header.startswith("access-control")]


@pytest.mark.parametrize(
    ("length", "status", "what"),
    [("65537", 413, "long body"), ("9" * 30, 413, "long body"), ("-1", 400, "bad length"), ("0x10", 400, "bad length"),
     ("1e9", 400, "bad length"), ("², ", 400, "bad length")],
)  # fmt: skip
@in_virtual_time
async def test_a_body_that_is_said_to_be_too_long_is_not_read(length: str, status: int, what: str) -> None:
    await Rig().refused(status, what, "POST", "/captures/clean", [OWN, JSON, ("Content-Length", length)])


@in_virtual_time
async def test_a_body_that_grows_too_long_on_its_way_is_refused() -> None:
    rows = [OWN, JSON, ("Transfer-Encoding", "chunked")]
    await Rig().refused(413, "long body", "POST", "/captures/clean", rows, body=b"x" * 70_000)


@in_virtual_time
async def test_a_body_that_does_not_come_is_not_waited_for() -> None:
    import asyncio

    rig, sent = Rig(), []

    async def never() -> Message:
        await asyncio.sleep(1e6)
        return {}

    async def send(message: Message) -> None:
        sent.append(message)

    await rig.app(head("POST", "/captures/clean", [OWN, JSON, ("Content-Length", "9")]), never, send)
    assert sent[0]["status"] == 408
    assert rig.audit.has("slow body")


# --- roles -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "path"),
    [("DELETE", "/captures/one.mcap"), ("POST", "/captures/one.mcap/pin"), ("POST", "/captures/one.mcap/unpin"),
     ("POST", "/captures/clean"), ("POST", "/run"), ("POST", "/reset"), ("DELETE", "/stop"), ("POST", "/anything")],
)  # fmt: skip
@in_virtual_time
async def test_a_viewer_changes_nothing(method: str, path: str) -> None:
    rig = Rig(visitor=VIEWER)
    answer = await ask(rig.app, head(method, path, [OWN]))
    assert answer.status == 403
    assert b"viewer" in answer.body
    assert rig.audit.has("eve, session 12345678", "a viewer who wants to operate")
    assert not rig.echo.asked


@in_virtual_time
async def test_a_viewer_looks_and_stops() -> None:
    rig = Rig(visitor=VIEWER)
    for method, path in (("GET", "/"), ("GET", "/captures"), ("GET", "/captures/one.mcap/file"), ("POST", "/stop")):
        assert (await ask(rig.app, head(method, path, [OWN]))).status == 200
    assert rig.gate.allows(VIEWER, "look")
    assert rig.gate.allows(VIEWER, "stop")
    assert not rig.gate.allows(VIEWER, "operate")


@pytest.mark.parametrize(
    ("method", "path"), [("GET", "/"), ("POST", "/stop"), ("GET", "/captures"), ("GET", "/static/x")]
)
@in_virtual_time
async def test_nobody_gets_nothing(method: str, path: str) -> None:
    await Rig(visitor=None).refused(401, "nobody", method, path, [OWN])


@in_virtual_time
async def test_nobody_opens_no_socket() -> None:
    rig = Rig(visitor=None)
    assert not (await speak(rig.app, head(path="/live", headers=[OWN], scheme="ws"), ["hello"])).accepted
    assert rig.audit.has("nobody")


# --- answers ---------------------------------------------------------------------------------------------


@in_virtual_time
async def test_every_answer_has_the_security_headers() -> None:
    rig = Rig()
    for scope in (head(), head("POST", "/stop", [OWN]), head(host="evil.example"), head("GET", "/..")):
        answer = await ask(rig.app, scope)
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert "evil" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert answer.headers["cache-control"] == "no-store"
    assert "ws://127.0.0.1:8770" in (await ask(rig.app, head())).headers["content-security-policy"]
