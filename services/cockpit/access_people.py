"""Who is let in from other machines without a certificate: one-time codes and sessions, in the robot's run directory.

    <run>/<robot>/cockpit/invited/<hash of a code>     role, name, until when
                          sessions/<hash of a token>   role, name, until when, from where
                          address                      the URL under which others open the page

A code or a token itself is nowhere: who reads the folder cannot log in with what he finds. A code is taken by removing
its file, which succeeds once. `cocoro cockpit` writes and lists these files, the cockpit reads them; a session whose
file is gone has ended, so `cocoro cockpit end` needs no answer. Times are those since the machine was started: setting
its clock prolongs nothing, and what another start of the machine has left is of no use.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import msgspec

from cocoro import private
from cocoro.errors import ConfigError, RefusedError, choice_of
from cocoro.private import default_run_dir
from services.cockpit.access_rules import Role

ROLES: tuple[Role, ...] = get_args(Role)
CODE_S = 600.0
"""For so long a code can be used."""
SESSION_S = 12 * 3600.0
INVITED_MOST = 32
SESSIONS_MOST = 64
ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
"""Of codes: no letters that look like a digit."""
CODE_LENGTH = 12
"""60 random bits."""
TOKEN_BYTES = 32
FILE_BYTES = 4096
NAME_MOST = 32
INVITED, SESSIONS = "invited", "sessions"
ADDRESS, ADDRESS_BYTES = "address", 1024
"""File with the URL under which the page is served."""
_HASH_DIGITS = 64
_BOOT = Path("/proc/sys/kernel/random/boot_id")


class Invited(msgspec.Struct, frozen=True, kw_only=True):
    """A code that was given out, or a session that began with it."""

    name: str
    role: Role
    until_s: float
    """By the time since the machine was started."""
    boot: str
    """Which start of the machine that was."""
    address: str = ""
    """Of a session: where it began."""


class Listed(NamedTuple):
    """A row of `cocoro cockpit list`."""

    key: str
    """The first digits of the hash, by which log lines and `end` name it."""
    kind: Literal["invited", "session"]
    name: str
    role: Role
    left_s: float
    address: str


def folder_of(robot: str) -> Path:
    """The folder of a robot's codes and sessions."""
    return default_run_dir() / robot / "cockpit"


def since_start_s() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def this_boot() -> str:
    with suppress(OSError):
        return _BOOT.read_text().strip()
    return ""


def role_of(text: str) -> Role:
    """A role, unchanged. Raises ConfigError for another word."""
    for role in ROLES:
        if role == text:
            return role
    raise ConfigError(f"{text!r} is no role of the cockpit; {choice_of(text, ROLES)}")


def named(text: str) -> str:
    """A person's name, unchanged. Raises ConfigError for one that would not fit into a line of the log."""
    if text and len(text) <= NAME_MOST and all(c.isalnum() or c in "._-" for c in text):
        return text
    raise ConfigError(f"--name {text!r}: give 1 to {NAME_MOST} letters, digits, dots, dashes and underscores")


def typed(code: str) -> str:
    """A code as a person types it, in its usual form."""
    text = "".join(c for c in code[:64].upper() if c.isalnum())
    return text.translate(str.maketrans("OIL", "011"))


def spaced(code: str) -> str:
    """A code in groups of four, as it is read aloud."""
    return "-".join(code[at : at + 4] for at in range(0, len(code), 4))


class People:
    """The codes and sessions of one robot.

    The methods raise ConfigError when the folder is not this user's alone, FullError when it cannot be written.
    """

    def __init__(
        self, folder: Path, now_s: Callable[[], float] = since_start_s, boot: Callable[[], str] = this_boot
    ) -> None:
        self.folder = folder
        self._now_s = now_s
        self._boot = boot()

    def invite(self, role: Role, name: str = "") -> str:
        """Makes a code for one login within CODE_S, and returns it. Raises RefusedError when too many are open."""
        self._must_have_room(INVITED, INVITED_MOST, "wait until one has expired, or end them: cocoro cockpit end all")
        code = "".join(secrets.choice(ALPHABET) for _ in range(CODE_LENGTH))
        key = _hash(code)
        row = Invited(name=name or f"guest-{key[:4]}", role=role, until_s=self._now_s() + CODE_S, boot=self._boot)
        private.write(self.folder / INVITED / key, msgspec.json.encode(row))
        return code

    def log_in(self, code: str, address: str) -> tuple[str, Invited] | None:
        """Takes a code, and returns the token of the session that begins; None for a code that is not, or no longer,
        valid. Raises RefusedError when there are too many sessions; then the code stays valid."""
        key = _hash(typed(code))
        invited = self._read(INVITED, key)
        if invited is None:
            return None
        self._must_have_room(SESSIONS, SESSIONS_MOST, "end some: cocoro cockpit list, cocoro cockpit end NAME")
        if not self._remove(INVITED, key):
            return None  # another login has taken it at the same time
        token = secrets.token_urlsafe(TOKEN_BYTES)
        session = msgspec.structs.replace(invited, until_s=self._now_s() + SESSION_S, address=address)
        private.write(self.folder / SESSIONS / _hash(token), msgspec.json.encode(session))
        return token, session

    def session(self, token: str) -> tuple[str, Invited] | None:
        """The key of a token's session, and the session; None when there is none, or when it has ended."""
        key = _hash(token)
        found = self._read(SESSIONS, key)
        return None if found is None else (key, found)

    def log_out(self, token: str) -> bool:
        return self._remove(SESSIONS, _hash(token))

    def listed(self) -> list[Listed]:
        """The open codes and sessions, the newest last. Those that have ended are removed."""
        return sorted((*self._rows(INVITED), *self._rows(SESSIONS)), key=lambda row: (row.kind, row.left_s))

    def end(self, who: str) -> list[Listed]:
        """Ends the codes and sessions of a name or a key, or all; returns them. Raises ConfigError for a name that has
        none."""
        rows = self.listed()
        found = [row for row in rows if who in ("all", row.name, row.key)]
        if not found and who != "all":
            raise ConfigError(f"{who!r} has no code and no session; {choice_of(who, [row.name for row in rows])}")
        for row in found:
            place = INVITED if row.kind == "invited" else SESSIONS
            for key in self._keys(place):
                if key.startswith(row.key):
                    self._remove(place, key)
        return found

    def serves(self, url: str | None) -> None:
        """Tells `cocoro cockpit` where others open the page; None: nowhere. Where that cannot be written, the cockpit
        works all the same."""
        with suppress(FileNotFoundError, ConfigError):
            if url is not None:
                private.write(self.folder / ADDRESS, url.encode())
                return
            with private.directory(self.folder) as fd:
                os.unlink(ADDRESS, dir_fd=fd)

    def _must_have_room(self, place: str, most: int, advice: str) -> None:
        if len(self._keys(place)) >= most and len([*self._rows(place)]) >= most:
            what = "codes are open" if place == INVITED else "sessions are open"
            raise RefusedError(f"{most} {what} already: {advice}")

    def _rows(self, place: str) -> Iterator[Listed]:
        now_s = self._now_s()
        for key in self._keys(place):
            row = self._read(place, key)
            if row is None:
                self._remove(place, key)
            else:
                kind: Literal["invited", "session"] = "invited" if place == INVITED else "session"
                yield Listed(key[:8], kind, row.name, row.role, row.until_s - now_s, row.address)

    def _keys(self, place: str) -> list[str]:
        try:
            with private.directory(self.folder / place) as fd:
                names = os.listdir(fd)  # noqa: PTH208 # by descriptor
        except FileNotFoundError:
            return []
        return sorted(name for name in names if len(name) == _HASH_DIGITS)

    def _read(self, place: str, key: str) -> Invited | None:
        """What a file says, when it is valid now."""
        try:
            row = msgspec.json.decode(private.read(self.folder / place / key, FILE_BYTES), type=Invited)
        except (FileNotFoundError, msgspec.DecodeError):
            return None
        longest_s = CODE_S if place == INVITED else SESSION_S
        left_s = row.until_s - self._now_s()
        return row if row.boot == self._boot and 0 < left_s <= longest_s else None

    def _remove(self, place: str, key: str) -> bool:
        """Removes a file; returns whether this call did."""
        try:
            with private.directory(self.folder / place) as fd:
                os.unlink(key, dir_fd=fd)
        except FileNotFoundError:
            return False
        return True


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()
