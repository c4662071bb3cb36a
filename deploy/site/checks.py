"""The lines of `cocoro doctor` about a site's certificates."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from cocoro.checks import Check, bad, note, ok
from cocoro.errors import ConfigError
from deploy import extras
from deploy.site import admitted
from deploy.site.admitted import Admitted
from deploy.site.place import ADMITTED, CREDENTIALS

SOON_DAYS = 14
"""A certificate that expires within this time is named."""


def certificate_checks(site: Path, now: datetime) -> Iterator[Check]:
    """Whether the credentials that lie here are good, and which of the site's certificates expire soon.

    Credentials that lie here and are not valid are a problem of this machine. Those of others are a note: a person who
    has left, say, is no reason for this robot not to start.
    """
    try:
        known = admitted.read(site)
    except ConfigError as error:
        yield bad("site", str(error))
        return
    here = _here(site)
    for folder in here:
        yield _credentials(folder, known, now)
    yield _others(site, known, {folder.name for folder in here}, now)


def _here(site: Path) -> list[Path]:
    """The folders of credentials on this machine."""
    try:
        return sorted(path for path in (site / CREDENTIALS).iterdir() if not path.name.startswith("."))
    except OSError:  # there are none, or they are another user's
        return []


def _credentials(folder: Path, known: Admitted, now: datetime) -> Check:
    what = f"credentials of {folder.name}"
    try:
        from deploy.site import credentials
    except ModuleNotFoundError as error:
        return bad(what, extras.advice_of(error) or str(error))
    try:
        found = credentials.read(folder, now, name=folder.name, authority=known.authority)
        newest = known.newest(found.name)
    except ConfigError as error:
        return bad(what, str(error))
    row = next((each for each in known.certificate if each.common_name == found.common_name), None)
    if newest.revoked or (row is not None and row.revoked):
        return bad(what, f"{found.common_name} is revoked, so nobody admits it: remove {folder}")
    until = f"{found.common_name}, {found.role}, valid until {found.expires:%Y-%m-%d}"
    if found.generation < newest.generation:
        return note(what, f"{until}, but {newest.common_name} is issued: copy the folder from the machine that issues")
    if (left := (found.expires - now).days) < SOON_DAYS:
        return note(what, f"{until}, in {_days(left)}: {_renew(found.name)}")
    return ok(what, until)


def _others(site: Path, known: Admitted, here: set[str], now: datetime) -> Check:
    """The certificates of the names whose credentials do not lie here."""
    newest = [each for each in map(known.newest, known.names) if not each.revoked]
    late = [each for each in newest if each.name not in here and each.days_left(now) < SOON_DAYS]
    if not late:
        return ok("site", f"{site / ADMITTED} names {len(newest)} with a certificate")
    texts = [
        f"{each.common_name} expires in {_days(each.days_left(now))}"
        if each.is_valid(now)
        else f"{each.common_name} has expired"
        for each in late
    ]
    return note("site", f"{', '.join(texts)}: {_renew('NAME')}")


def _days(days: int) -> str:
    return "1 day" if days == 1 else f"{days} days"


def _renew(name: str) -> str:
    return f"`cocoro pki renew {name}` on the machine that issues"
