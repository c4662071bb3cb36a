"""The visitors that have a client's certificate of a site: by the site's plan and by who is admitted now.

TLS has verified that the site's authority issued the certificate. What it does not know is read here, again when a file
has changed: which person the plan has, in which role and for which robots, and which certificates are revoked. The
folder is that of `cocoro site` and `cocoro pki`; a service reads it without their modules, which stand above it.
"""

from __future__ import annotations

import os
import ssl
import stat
import time
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from cocoro.errors import ConfigError
from services.cockpit.access import Certificates
from services.cockpit.access_limits import Clock
from services.cockpit.access_rules import Role

PLAN, ADMITTED = "site.toml", "admitted.toml"
LOOK_S = 1.0
"""Time between two looks at the files."""
FILE_BYTES = 4_000_000
PERSONS: Mapping[str, Role] = {"operator": "operator", "viewer": "viewer", "author": "viewer"}
"""The roles of persons in a site, and what they are here. A machine's certificate opens no cockpit."""


class _Person(msgspec.Struct, frozen=True):
    role: str
    robots: list[str] | None = None


class _Plan(msgspec.Struct, frozen=True):
    person: dict[str, _Person] = {}


class _Row(msgspec.Struct, frozen=True):
    name: str
    role: str
    generation: int
    serial: str
    revoked: bool = False


class _Admitted(msgspec.Struct, frozen=True):
    authority: str
    certificate: list[_Row] = []


class SiteCertificates(Certificates):
    """Reads a site's folder. A file that cannot be read admits nobody."""

    def __init__(
        self,
        site: Path,
        robot: str,
        *,
        clock: Clock = time.monotonic,
        wall_s: Callable[[], float] = time.time,
        complain: Callable[[str], None] = lambda _: None,
    ) -> None:
        """`wall_s`: the time by which certificates expire. `complain` gets what is wrong with a file, once."""
        self._site, self._robot = site, robot
        self._clock, self._wall_s, self._complain = clock, wall_s, complain
        self._looked_s = -LOOK_S
        self._stamp: object = None
        self._plan, self._admitted = _Plan(), _Admitted("")

    @property
    def authority(self) -> str:
        """SHA-256 of the authority's certificate, by admitted.toml; empty when that cannot be read."""
        self._look()
        return self._admitted.authority

    def visitor(self, certificate: dict[str, Any]) -> tuple[str, Role] | None:
        self._look()
        subject = {key: value for part in certificate.get("subject", ()) for key, value in part}
        name, _, number = subject.get("commonName", "").rpartition(".")
        person = self._plan.person.get(name)
        if person is None or person.role not in PERSONS or person.role != subject.get("organizationalUnitName"):
            return None
        if person.robots is not None and self._robot not in person.robots:
            return None
        if not number.isdecimal() or ssl.cert_time_to_seconds(certificate["notAfter"]) <= self._wall_s():
            return None
        serial = certificate.get("serialNumber", "").lower().lstrip("0")
        return (name, PERSONS[person.role]) if self._is_admitted(name, int(number), serial) else None

    def _is_admitted(self, name: str, generation: int, serial: str) -> bool:
        rows = [row for row in self._admitted.certificate if row.name == name]
        if not rows:
            return False
        for row in rows:
            if row.generation == generation:
                return not row.revoked and row.serial == serial
        newest = max(rows, key=lambda row: row.generation)  # the next one, before the new file has come here
        return generation == newest.generation + 1 and not newest.revoked

    def _look(self) -> None:
        """Reads the files again when they have changed."""
        now_s = self._clock()
        if now_s - self._looked_s < LOOK_S:
            return
        self._looked_s = now_s
        try:
            stamp = [_stamp(self._site / name) for name in (PLAN, ADMITTED)]
            if stamp == self._stamp:
                return
            self._stamp = stamp
            plan, admitted = _read(self._site / PLAN, _Plan), _read(self._site / ADMITTED, _Admitted)
        except ConfigError as error:
            self._stamp, self._plan, self._admitted = None, _Plan(), _Admitted("")
            self._complain(f"nobody is let in by certificate: {error}")
            return
        self._plan, self._admitted = plan, admitted


def _stamp(path: Path) -> tuple[int, int, int]:
    """What changes when a file changes. Raises ConfigError for one that is missing or that others could have
    written."""
    try:
        found = path.stat()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; copy it from another machine of the site") from error
    if not stat.S_ISREG(found.st_mode) or found.st_uid not in (0, os.geteuid()) or found.st_mode & 0o022:
        raise ConfigError(f"{path}: others may change it: give it to $USER, with mode 644")
    return found.st_mtime_ns, found.st_ino, found.st_size


def _read(path: Path, kind: type[Any]) -> Any:
    """Raises ConfigError."""
    try:
        with path.open("rb") as file:
            return msgspec.convert(tomllib.loads(file.read(FILE_BYTES).decode()), kind)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # of TOML, of UTF-8, of msgspec
        raise ConfigError(f"{path}: {error}; copy it again from another machine of the site") from error
