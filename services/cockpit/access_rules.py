"""Which requests the cockpit takes at all, by their head alone: pure rules, each with the reason that it gives.

A page of another site can make a browser send requests here: forms, pictures, WebSockets. It cannot forge where they
come from: `Origin`, `Sec-Fetch-Site` and `Host` tell that. Host is checked against DNS rebinding, by which a foreign
name is made to lead here, so that to the browser the foreign page and the cockpit are of one origin.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Collection, Mapping, MutableMapping
from typing import Any, Literal, NamedTuple
from urllib.parse import unquote_to_bytes

Scope = MutableMapping[str, Any]
"""Of ASGI: what a server knows of a request before its body."""

VISITOR = "cocoro.visitor"
"""Where a scope has its visitor."""
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
METHODS = ("GET", "HEAD", "POST", "DELETE")
CHANGING = ("POST", "DELETE")
PATH_MOST = 1024
PROXY_HEADERS = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-forwarded-proto", "x-real-ip", "via")
FORM, JSON = "application/x-www-form-urlencoded", "application/json"

Role = Literal["viewer", "operator"]
Doing = Literal["look", "stop", "operate"]
"""What a visitor asks for."""
MAY: Mapping[Role, tuple[Doing, ...]] = {"viewer": ("look", "stop"), "operator": ("look", "stop", "operate")}
"""What each role may do."""
POSTS: Mapping[str, Doing] = {"/stop": "stop", "/logout": "look"}
"""What requests that change something are for; all others are for operating."""


class Refusal(NamedTuple):
    """Why a request is not taken."""

    status: int
    """Of HTTP."""
    what: str
    """For the log: one of few texts, without anything of the client's."""
    text: str
    """For the client: what is wrong, and what to do."""


def headers_of(scope: Scope) -> dict[str, list[str]]:
    """The values of each header, by its name in small letters."""
    found: dict[str, list[str]] = {}
    for name, value in scope.get("headers", ()):
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
    return found


def bad_path(raw: bytes) -> Refusal | None:
    """Refuses a path that could lead out of a folder, however it is encoded. Names of captures need none of that."""
    decoded = unquote_to_bytes(raw)
    text = decoded.decode("utf-8", "replace")
    parts = text.split("/")
    wrong = (
        not raw.startswith(b"/")
        or len(raw) > PATH_MOST
        or b"%" in decoded  # encoded twice
        or "\\" in text
        or "\ufffd" in text
        or "//" in text
        or any(part in (".", "..") for part in parts)
        or b"%2f" in raw.lower()
        or not text.isprintable()
    )
    return Refusal(400, "bad path", "This path is not one of the cockpit's.\n") if wrong else None


def bad_host(headers: Mapping[str, list[str]], names: Collection[str]) -> Refusal | None:
    """Refuses a request that was meant for another name than one of `names` (small letters, without a port)."""
    hosts = headers.get("host", [])
    name = host_name(hosts[0]) if len(hosts) == 1 else None
    if name is not None and name in names:
        return None
    known = ", ".join(sorted(names))
    return Refusal(421, "foreign host", f"The cockpit answers under these names alone: {known}.\n")


def host_name(host: str) -> str | None:
    """The name of a Host header, without its port; None for one that is malformed."""
    match = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(:[0-9]{1,5})?", host)
    if match is None:
        return None
    name = match[1].strip("[]").lower().rstrip(".")
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return name


def bad_origin(scope: Scope, headers: Mapping[str, list[str]], *, cookie: bool) -> Refusal | None:
    """Refuses what another page has made a browser send. `cookie`: the request is known by its cookie, which a browser
    adds by itself, so a change must say where it comes from."""
    refusal = Refusal(403, "foreign origin", "The cockpit takes requests of its own page alone.\n")
    scheme = {"ws": "http", "wss": "https"}.get(scope["scheme"], scope["scheme"])
    origins = headers.get("origin", [])
    if len(origins) > 1:
        return refusal
    if origins and origins[0].lower() != f"{scheme}://{headers['host'][0]}".lower():
        return refusal
    method = scope.get("method", "GET")
    sites = headers.get("sec-fetch-site", [])
    if sites and sites != ["same-origin"]:
        # A person followed a link or typed the address: only the page itself is opened that way, and in no frame.
        opened = headers.get("sec-fetch-mode") == ["navigate"] and headers.get("sec-fetch-dest") == ["document"]
        if not (scope["type"] == "http" and method in ("GET", "HEAD") and opened and len(sites) == 1):
            return refusal
    changes = scope["type"] == "websocket" or method in CHANGING
    if cookie and changes and not origins and sites != ["same-origin"]:
        return refusal
    return None


def proxied(headers: Mapping[str, list[str]]) -> Refusal | None:
    """Refuses what a proxy on this machine passes on: its own user is not the person who asks."""
    if any(name in headers for name in PROXY_HEADERS):
        text = "A proxy on this machine passes this on, and everybody behind it would be this machine's user. "
        return Refusal(403, "proxy", f"{text}Let the cockpit listen beyond loopback by itself, with TLS.\n")
    return None


def bad_body(scope: Scope, headers: Mapping[str, list[str]], most: int) -> Refusal | None:
    """Refuses a body that is too long, or of a type that a form of another page can send."""
    lengths = headers.get("content-length", [])
    if any(not length.isascii() or not length.isdigit() for length in lengths):
        return Refusal(400, "bad length", "Content-Length is no number.\n")
    if any(len(length) > 12 or int(length) > most for length in lengths):
        return Refusal(413, "long body", f"A request's body may have {most} bytes.\n")
    if scope["method"] not in CHANGING or is_stop(scope):  # whatever a STOP has with it, it is one
        return None
    has_body = "transfer-encoding" in headers or any(int(length) for length in lengths)
    kinds = [kind.partition(";")[0].strip().lower() for kind in headers.get("content-type", [])]
    wanted = FORM if scope["path"] == "/login" else JSON
    if has_body and kinds != [wanted]:
        return Refusal(415, "body's type", f"A body must be {wanted}.\n")
    return None


def is_stop(scope: Scope) -> bool:
    """Whether a request is the emergency stop."""
    return (scope["type"], scope.get("method"), scope["path"]) == ("http", "POST", "/stop")


def doing_of(method: str, path: str) -> Doing:
    """What a request of HTTP is for."""
    return "look" if method in ("GET", "HEAD") else POSTS.get(path, "operate") if method == "POST" else "operate"


def security_headers(host: str, *, tls: bool) -> list[tuple[bytes, bytes]]:
    """What the browser must not do with an answer. `host` as the browser wrote it: some take `'self'` for HTTP alone,
    and not for WebSockets."""
    socket = f"{'wss' if tls else 'ws'}://{host}"
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; font-src 'self'; "
        f"connect-src 'self' {socket}; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
        "frame-ancestors 'none'"
    )
    rows = {
        "content-security-policy": policy,
        "x-content-type-options": "nosniff",
        "x-frame-options": "DENY",
        "referrer-policy": "no-referrer",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "cross-origin-embedder-policy": "require-corp",
        "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=(), serial=()",
    }
    return [(name.encode(), value.encode()) for name, value in rows.items()]
