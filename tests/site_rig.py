"""A site in a temporary folder, and handshakes between its credentials without a network."""

from __future__ import annotations

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

HALL = """
name = "hall"
[robot.a]
profile = "sim"
[robot.b]
profile = "sim"
[host.hub]
role = "hub"
listen = ["tls/10.77.0.9:7447"]
[host.one]
role = "robot"
robot = "a"
processes = ["capture", "sim", "perception", "planning", "executive"]
[host.two]
role = "robot"
robot = "b"
processes = ["capture", "sim"]
[host.mind]
role = "brain"
robot = "b"
processes = ["perception", "planning", "executive"]
[person.ada]
role = "operator"
[person.bo]
role = "viewer"
robots = ["b"]
"""
NOW = datetime(2031, 5, 1, 12, 0, tzinfo=UTC)
DAY = timedelta(days=1)
ADDRESS = "10.77.0.1"
LAB = """
name = "lab"
[robot.calliope]
profile = "sim"
[host.body]
role = "robot"
processes = ["capture", "sim"]
listen = ["tls/10.77.0.1:7447"]
[host.brain]
role = "brain"
processes = ["perception", "planning", "executive"]
[person.ada]
role = "operator"
[person.eve]
role = "viewer"
"""


def context(folder: Path | None, *, server: bool, ca: Path | None = None) -> ssl.SSLContext:
    """A context with the credentials of a folder; `ca` instead of the folder's own authority."""
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    made.verify_mode = ssl.CERT_REQUIRED
    trusted = ca or (folder / "ca.pem" if folder is not None else None)
    assert trusted is not None
    made.load_verify_locations(trusted)
    if folder is not None:
        made.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    return made


def handshake(server: ssl.SSLContext, client: ssl.SSLContext, address: str = ADDRESS) -> tuple[str, str]:
    """The common names that the server saw, and the client. Raises ssl.SSLError when one of them refuses."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server, server_hostname=address),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    waiting = list(ends)
    for _ in range(20):
        for end in list(waiting):
            try:
                end.do_handshake()
                waiting.remove(end)
            except ssl.SSLWantReadError:
                pass
    assert not waiting
    ends[0].write(b"a word")  # with TLS 1.3 the server refuses a client after the client's own part is done
    assert ends[1].read() == b"a word"
    return _common_name(ends[1]), _common_name(ends[0])


def _common_name(end: ssl.SSLObject) -> str:
    certificate: Any = end.getpeercert()
    return next(str(value) for ((key, value),) in certificate["subject"] if key == "commonName")
