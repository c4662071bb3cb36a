"""The checks of `cocoro doctor` for the cockpit, while it is down: how it would be reached, and by whom."""

from __future__ import annotations

import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cocoro.checks import Check, bad, note, ok
from cocoro.errors import ConfigError
from cocoro.robot import Robot
from services.cockpit.access_certificates import SiteCertificates
from services.cockpit.access_peer import Peers
from services.cockpit.access_people import People, folder_of
from services.cockpit.access_tls import Entrance, entrance
from services.cockpit.config import CockpitConfig
from services.cockpit.server import listen

__all__ = ["check"]

SOON = timedelta(days=14)
"""A certificate that expires within this time is named."""


def check(config: CockpitConfig, robot: Robot, robot_name: str) -> list[Check]:
    try:
        found = entrance(config)
        with listen(found.host, config.port) as listening:
            port = listening.getsockname()[1]
    except ConfigError as error:
        return [bad("cockpit", str(error))]
    return [_page(found, config.port, port), _peers(), *_tls(found, config, robot_name), *_people(found, robot_name)]


def _page(found: Entrance, wanted: int, port: int) -> Check:
    url, whom = found.url(port), "others with a certificate or a code" if found.beyond else "this machine's user alone"
    if wanted and port != wanted:
        return note("cockpit", f"port {wanted} is taken: the page will be at {url}")
    return ok("cockpit", f"{found.url(port) if wanted else 'any free port'}, for {whom}")


def _peers() -> Check:
    """Whether the kernel tells whose process is at the other end."""
    peers = Peers()
    try:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            ends = listener.getsockname()
            with socket.create_connection(ends) as client:
                known = peers.user(client.getsockname(), ends) is not None
                if known and peers.quick:
                    return ok("cockpit's visitors", "the kernel tells whose process asks")
    finally:
        peers.close()
    if known:
        return note("cockpit's visitors", "sock_diag is not allowed here: each new connection takes some ms")
    return bad("cockpit's visitors", "the kernel does not tell whose process asks, so nobody is let in: mount /proc")


def _tls(found: Entrance, config: CockpitConfig, robot_name: str) -> list[Check]:
    if found.served is None:
        return []
    left = found.served.expires - datetime.now(UTC)
    text = f"{found.served.cert}, until {found.served.expires:%Y-%m-%d}"
    checks = [note("cockpit's certificate", f"{text}: renew it") if left < SOON else ok("cockpit's certificate", text)]
    if config.site:
        said: list[str] = []
        known = SiteCertificates(Path(config.site), robot_name, complain=said.append).authority
        checks.append(bad("cockpit's site", said[0]) if said else _site(found, config.site, known))
    return checks


def _site(found: Entrance, site: str, authority: str) -> Check:
    """Whether the authority that verifies clients is the site's."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    assert found.ca is not None
    shown = x509.load_pem_x509_certificate(found.ca.read_bytes()).fingerprint(hashes.SHA256()).hex()
    if shown != authority:
        return bad("cockpit's site", f"{found.ca} is not the authority that {site} names: copy the credentials again")
    return ok("cockpit's site", f"persons of {site} are let in by their certificates")


def _people(found: Entrance, robot_name: str) -> list[Check]:
    if found.served is None:
        return []
    try:
        rows = People(folder_of(robot_name)).listed()
    except ConfigError as error:
        return [bad("cockpit's sessions", str(error))]
    return [ok("cockpit's sessions", f"{len(rows)} codes and sessions: `cocoro cockpit list`")]
