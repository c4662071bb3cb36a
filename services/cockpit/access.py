"""Who may use the cockpit: the gate that each request passes before the service sees it.

On loopback a visitor is this machine's user, as the kernel knows the process at the other end. From elsewhere he has
a certificate of the site, or a session that began with a one-time code. A viewer looks and stops; an operator does
everything. What is refused gets a reason, and a line in the log (`access_limits.Audit`).

STOP has budgets of its own, which nothing else uses up.
"""

from __future__ import annotations

import pwd
import time
from collections.abc import Awaitable, Callable, Collection, MutableMapping
from contextlib import suppress
from typing import Any, NamedTuple

from cocoro.errors import CocoroError, RefusedError
from services.cockpit import access_rules as rules
from services.cockpit.access_connection import Connection
from services.cockpit.access_door import Door
from services.cockpit.access_limits import Audit, Budgets, Clock, DoorLimits, Rate
from services.cockpit.access_login import CODE_FIELD, login_page, style
from services.cockpit.access_people import SESSION_S, People
from services.cockpit.access_rules import Doing as Doing
from services.cockpit.access_rules import Refusal, Role, Scope

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

LOGIN_BYTES = 1024
"""Of the form with a code."""
COOKIE = "__Host-cockpit"
"""A browser sends a cookie of this prefix to this host alone, over TLS alone."""


class Visitor(NamedTuple):
    """Somebody who may use the cockpit."""

    name: str
    role: Role
    key: str = ""
    """Of his budgets and log lines: this machine's user, his session or his certificate."""


class GateLimits(NamedTuple):
    """What visitors may cost."""

    requests: Rate = Rate(20.0, 120.0)
    """Of one visitor, or of one address of nobody's. The page and its files are 60 requests."""
    requests_of_nobody: Rate = Rate(20.0, 60.0)
    """Of all who are not let in."""
    stops: Rate = Rate(5.0, 10.0)
    """STOPs of one visitor, by request or by message."""
    logins: Rate = Rate(1 / 12, 5.0)
    """Of one address."""
    logins_all: Rate = Rate(0.5, 20.0)
    sockets: int = 8
    """Of one visitor."""
    sockets_all: int = 32
    openings: Rate = Rate(2.0, 20.0)
    """New sockets of one visitor: each costs the service more than a request does."""
    messages: Rate = Rate(100.0, 200.0)
    """Of one socket. The page sends 25 a second while somebody drives, and 15 for pictures."""
    message_bytes: int = 64 * 1024
    body_bytes: int = 64 * 1024
    body_s: float = 10.0
    """Until a request's body is whole."""
    again_s: float = 1.0
    """After this time a socket's visitor is looked up again: his session may have ended."""


class Certificates:
    """Tells the visitor of a client's certificate; without a site, nobody. See `access_certificates`."""

    def visitor(self, certificate: dict[str, Any]) -> tuple[str, Role] | None:
        return None


class Gate:
    """Judges requests by what the door, the people and the certificates know."""

    def __init__(
        self,
        *,
        names: Collection[str] = rules.LOOPBACK_NAMES,
        tls: bool = False,
        people: People | None = None,
        certificates: Certificates | None = None,
        limits: GateLimits | None = None,
        door_limits: DoorLimits | None = None,
        audit: Audit | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """`names`: those under which the cockpit is reached, in small letters. Without `people` nobody can log in."""
        self.names = frozenset(names)
        self.tls = tls
        self.audit = audit or Audit(clock)
        self.limits = limits or GateLimits()
        self.door_limits = door_limits or DoorLimits()
        self.door: Door | None = None
        """Set when it is open."""
        self.clock = clock
        self._people, self._certificates = people, certificates or Certificates()
        self._requests = Budgets(self.limits.requests, clock)
        self._requests_of_nobody = Budgets(self.limits.requests_of_nobody, clock)
        self.stops = Budgets(self.limits.stops, clock)
        self._logins = Budgets(self.limits.logins, clock)
        self._logins_all = Budgets(self.limits.logins_all, clock)
        self.openings = Budgets(self.limits.openings, clock)
        self.sockets: dict[str, int] = {}
        """Open sockets, by the visitor's key."""

    # --- what the service asks --------------------------------------------------------------------

    def who(self, scope: Scope) -> Visitor | None:
        """The visitor of a request; None when it is nobody's."""
        found = scope.get(rules.VISITOR)
        return found if isinstance(found, Visitor) else self.looked_up(scope)

    def allows(self, visitor: Visitor, doing: Doing) -> bool:
        """Whether a visitor may do that. A refusal is logged."""
        allowed = doing in rules.MAY[visitor.role]
        if not allowed:
            self.audit.refused(f"{visitor.name}, {visitor.key}", f"a {visitor.role} who wants to {doing}")
        return allowed

    # --- what the passage asks --------------------------------------------------------------------

    def looked_up(self, scope: Scope) -> Visitor | None:
        """As `who`, looked up anew."""
        connection = self.connection(scope)
        if connection is not None and connection.user is not None:
            return Visitor(_user(connection.user), "operator", connection.key)
        if connection is not None and connection.certificate is not None:
            found = self._certificates.visitor(connection.certificate)
            if found is not None:
                return Visitor(*found, f"certificate {found[0]}")
        token = self.token(scope)
        if token is None or self._people is None:
            return None
        try:
            session = self._people.session(token)
        except CocoroError as error:
            self.audit.refused("everybody", "sessions cannot be read", str(error))
            return None
        return None if session is None else Visitor(session[1].name, session[1].role, f"session {session[0][:8]}")

    def connection(self, scope: Scope) -> Connection | None:
        return None if self.door is None else self.door.find(scope.get("client"))

    def token(self, scope: Scope) -> str | None:
        """The token of a request's cookie."""
        if not self.tls:
            return None
        for header in rules.headers_of(scope).get("cookie", ()):
            for part in header.split(";"):
                name, _, value = part.strip().partition("=")
                if name == COOKIE:
                    return value
        return None

    def address(self, scope: Scope) -> str:
        """The client, for budgets and log lines."""
        connection = self.connection(scope)
        return connection.key if connection is not None else str((scope.get("client") or ("?",))[0])

    def judge(self, scope: Scope, headers: dict[str, list[str]]) -> Refusal | None:
        """Refuses a request by its head, whoever sends it."""
        connection = self.connection(scope)
        if self.door is not None and connection is None:
            return Refusal(403, "unknown connection", "This connection has ended.\n")
        refusal = rules.bad_path(scope.get("raw_path") or scope["path"].encode()) or rules.bad_host(headers, self.names)
        if refusal is None and connection is not None and connection.user is not None:
            refusal = rules.proxied(headers)
        if refusal is None:
            refusal = rules.bad_origin(scope, headers, cookie="cookie" in headers)
        if refusal is None and scope["type"] == "http":
            if scope["method"] not in rules.METHODS:
                return Refusal(405, "method", f"The cockpit knows {', '.join(rules.METHODS)}.\n")
            refusal = rules.bad_body(scope, headers, self.limits.body_bytes)
        return refusal

    def overdrawn(self, scope: Scope, visitor: Visitor | None) -> Refusal | None:
        """Refuses a request beyond the budgets. One that is rightly known does not share his with the others."""
        if visitor is not None and rules.is_stop(scope):
            if self.stops.take(visitor.key):
                return None
            return Refusal(429, "too many stops", "The robot is being stopped already.\n")
        if not self._requests.take(self.address(scope) if visitor is None else visitor.key):
            return Refusal(429, "too many requests", "Too many requests: wait a second.\n")
        if visitor is None and not self._requests_of_nobody.take(""):
            return Refusal(503, "too many requests of nobody", "Too many requests: wait a second.\n")
        return None

    # --- logging in and out -----------------------------------------------------------------------

    async def own_page(self, scope: Scope, receive: Receive) -> tuple[int, list[tuple[bytes, bytes]], bytes] | None:
        """Status, headers and body of an answer that the gate gives by itself; None for the service's pages."""
        method, path = scope.get("method"), scope["path"]
        if path == "/login.css" and method == "GET":
            return 200, [(b"content-type", b"text/css; charset=utf-8")], style()
        if path == "/login" and method in ("GET", "HEAD"):
            return _html(200, login_page())
        if path == "/login" and method == "POST":
            return self._log_in(scope, await whole_body(receive, LOGIN_BYTES))
        if path == "/logout" and method == "POST":
            token = self.token(scope)
            if token is not None and self._people is not None and self._people.log_out(token):
                self.audit.done(self.address(scope), "logged out")
            return 303, [(b"location", b"/login"), (b"set-cookie", _cookie("", 0.0))], b""
        return None

    def _log_in(self, scope: Scope, body: bytes) -> tuple[int, list[tuple[bytes, bytes]], bytes]:
        address = self.address(scope)
        if self._people is None or not self.tls:
            return _html(403, login_page("There is no logging in here: the cockpit is open to this machine alone."))
        if not self._logins.take(address) or not self._logins_all.take(""):
            self.audit.refused(address, "too many logins")
            return _html(429, login_page("Too many attempts: wait a minute."))
        try:
            begun = self._people.log_in(_field(body), address)
        except RefusedError as error:
            self.audit.refused(address, "login", str(error))
            return _html(503, login_page("Too many people are logged in."))
        except CocoroError as error:
            self.audit.refused("everybody", "sessions cannot be written", str(error))
            return _html(503, login_page("The cockpit cannot keep a session now; its log says why."))
        if begun is None:
            self.audit.refused(address, "login: no such code")
            return _html(403, login_page("This code is not valid, or no longer: ask for another."))
        token, session = begun
        self.audit.done(address, f"{session.name} logged in as {session.role}")
        return 303, [(b"location", b"/"), (b"set-cookie", _cookie(token, SESSION_S))], b""


async def whole_body(receive: Receive, most: int) -> bytes:
    """A request's body, at most `most` bytes of it."""
    body, more = b"", True
    while more and len(body) <= most:
        message = await receive()
        if message["type"] == "http.disconnect":
            break
        body += message.get("body", b"")
        more = message.get("more_body", False)
    return body[:most]


def _field(body: bytes) -> str:
    from urllib.parse import parse_qs

    with suppress(ValueError):
        return parse_qs(body.decode("ascii", "replace"), max_num_fields=4).get(CODE_FIELD, [""])[0]
    return ""


def _html(status: int, page: bytes) -> tuple[int, list[tuple[bytes, bytes]], bytes]:
    return status, [(b"content-type", b"text/html; charset=utf-8")], page


def _cookie(token: str, for_s: float) -> bytes:
    return f"{COOKIE}={token}; Path=/; Secure; HttpOnly; SameSite=Strict; Max-Age={for_s:.0f}".encode()


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"
