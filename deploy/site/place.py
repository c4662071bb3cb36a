"""Where a site's folder is, and what lies where in it. It imports little, for the help and completions of commands."""

from __future__ import annotations

import os
from pathlib import Path

from cocoro.errors import ConfigError

SITE = "COCORO_SITE"
"""Environment variable with the site's folder, as `DIR` or as `NAME@DIR`, for a person of that name."""
PLAN = "site.toml"
ADMITTED = "admitted.toml"
AUTHORITY = "authority"
"""Folder of the authority's key and certificate; only on the machine that issues."""
CREDENTIALS = "credentials"
"""Folder of the folders with credentials, one for each name."""
CA_KEY, CA_CERT = "ca.key", "ca.pem"
KEY, CERT = "key.pem", "cert.pem"
DAYS = 90
"""Days for which a certificate is valid, if nothing else is asked for."""


def found() -> Path | None:
    """The site's folder that this machine's user has set, or is in; None without one."""
    if given := os.environ.get(SITE):
        return Path(given.rpartition("@")[2]).absolute()
    return Path.cwd() if Path(PLAN).is_file() else None


def folder(given: Path | None = None) -> Path:
    """The site's folder: the given one, else that of `found`. Raises ConfigError without one."""
    place = found() if given is None else given.absolute()
    if place is None:
        raise ConfigError(f"no site is set: give --site DIR, set {SITE}, or change into the folder with {PLAN}")
    return place
