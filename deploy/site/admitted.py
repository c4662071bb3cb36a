"""admitted.toml: who has a certificate of a site. `cocoro pki` writes it; every machine of the site has a copy.

Zenoh compares a certificate's common name exactly and knows no list of revoked ones. So each certificate of a name has
a common name of its own, `NAME.GENERATION`, and access rules name those that are valid. They name the next generation,
too, so that a renewed certificate is admitted by machines that have not got the new file yet.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.errors import ConfigError, choice_of, field_text
from deploy.profiles import A_NAME, Name
from deploy.site import files
from deploy.site.place import ADMITTED
from deploy.site.roles import ROLES, Role

Time = Annotated[datetime, Meta(tz=True)]
HEAD = "# Who has a certificate of this site. `cocoro pki` writes this file; copy it to every machine of the site.\n"
DAY_S = 86_400
FIRST_YEAR, LAST_YEAR = 2000, 9000


class Certificate(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A certificate that was issued: a table `[[certificate]]`."""

    name: Name
    role: Role
    generation: Annotated[int, Meta(ge=1, le=999_999)]
    """How many certificates the name has had, with this one."""
    serial: Annotated[str, Meta(pattern=r"\A[0-9a-f]{1,40}\Z")]
    not_before: Time
    expires: Time
    addresses: tuple[Annotated[str, Meta(pattern=r"\A[0-9A-Za-z:._-]{1,253}\Z")], ...] = ()
    """IP addresses and names of the machine at which others connect to it."""
    revoked: bool = False

    @property
    def common_name(self) -> str:
        return f"{self.name}.{self.generation}"

    def is_valid(self, now: datetime) -> bool:
        """Whether it is neither revoked nor expired."""
        return not self.revoked and now < self.expires

    def days_left(self, now: datetime) -> int:
        """Whole days until it expires; below 0 when it has."""
        return int((self.expires - now).total_seconds() // DAY_S)


class Admitted(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file. Raises ConfigError where a method gets a name that is not in it."""

    authority: Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
    """SHA-256 of the authority's certificate: whose certificates these are."""
    certificate: tuple[Certificate, ...] = ()
    """In the order of issue; those of one name have ascending generations."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(each.name for each in self.certificate))

    def newest(self, name: str) -> Certificate:
        """The certificate of a name with the highest generation."""
        found = [each for each in self.certificate if each.name == name]
        if not found:
            raise ConfigError(f"{name} has no certificate: {choice_of(name, self.names)}")
        return found[-1]

    def common_names(self, name: str, now: datetime) -> tuple[str, ...]:
        """The common names by which a principal is admitted: of its generations that are neither revoked nor expired,
        and of the next one unless the newest is revoked."""
        newest = self.newest(name)
        of_it = [each for each in self.certificate if each.name == name]
        following = () if newest.revoked else (f"{name}.{newest.generation + 1}",)
        return (*(each.common_name for each in of_it if each.is_valid(now)), *following)

    def valid(self, now: datetime) -> tuple[str, ...]:
        """All common names that are admitted, by principal in the order of their first certificates."""
        return tuple(common for name in self.names for common in self.common_names(name, now))


def read(site: Path) -> Admitted:
    """Reads the file of a site's folder. Raises ConfigError that names file, table and field."""
    path = site / ADMITTED
    with files.opened(site, own=False) as fd:
        try:
            data = files.read_file(site, fd, ADMITTED)
        except FileNotFoundError:
            raise ConfigError(
                f"{path} is missing: copy it from another machine of the site; `cocoro pki init` makes a new site's"
            ) from None
    return parse(data, path)


def parse(data: bytes, path: Path) -> Admitted:
    """The file's content; `path` is for error messages. Raises ConfigError as `read` does."""
    try:
        tables = tomllib.loads(data.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}; copy it again from another machine of the site") from error
    if not isinstance(rows := tables.pop("certificate", []), list):
        raise ConfigError(f"{path}: certificate is no list of tables [[certificate]]")
    try:
        head = msgspec.convert(tables, Admitted)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {field_text(error, Admitted)}") from error
    found = tuple(_certificate(row, f"{path}, [[certificate]] {number}") for number, row in enumerate(rows, 1))
    _check(found, path)
    return msgspec.structs.replace(head, certificate=found)


def write(site: Path, fd: int, admitted: Admitted) -> None:
    """Replaces the file of a site's folder with the descriptor `fd`, in one step. Raises ConfigError, FullError."""
    data = text_of(admitted).encode()
    if parse(data, site / ADMITTED) != admitted:
        raise ConfigError(f"{site / ADMITTED}: this content would be read as another; nothing was written")
    files.replace_file(site, fd, ADMITTED, data)


def text_of(admitted: Admitted) -> str:
    """The file's text; no value needs an escape, as their patterns say."""
    return "\n".join([f'{HEAD}authority = "{admitted.authority}"\n', *map(_table, admitted.certificate)])


def named(text: str) -> str:
    """A name for a principal, unchanged. Raises ConfigError for what is none."""
    try:
        return msgspec.convert(text, Name)
    except msgspec.ValidationError:
        raise ConfigError(f"{text!r}: {A_NAME}") from None


def role_of(text: str) -> Role:
    """A role, unchanged. Raises ConfigError for another word."""
    for role in ROLES:
        if role == text:
            return role
    raise ConfigError(f"{text!r} is no role; {choice_of(text, ROLES)}")


def _certificate(row: object, where: str) -> Certificate:
    try:
        return msgspec.convert(row, Certificate)
    except msgspec.ValidationError as error:
        text = field_text(error, Certificate)
        raise ConfigError(f"{where}: {f'name: {A_NAME}' if text.startswith('name: ') else text}") from error


def _check(found: Iterable[Certificate], path: Path) -> None:
    """Raises ConfigError for tables that contradict one another."""
    last: dict[str, int] = {}
    serials: dict[str, int] = {}
    for number, each in enumerate(found, 1):
        where = f"{path}, [[certificate]] {number}"
        if each.generation <= last.get(each.name, 0):
            raise ConfigError(f"{where}: generation: {each.name} has had {last[each.name]} before; they must ascend")
        if each.serial in serials:
            raise ConfigError(f"{where}: serial: it is that of [[certificate]] {serials[each.serial]}")
        if not (each.not_before.year >= FIRST_YEAR and each.expires.year <= LAST_YEAR):
            raise ConfigError(f"{where}: not_before, expires: a year is not between {FIRST_YEAR} and {LAST_YEAR}")
        if each.expires <= each.not_before:
            raise ConfigError(f"{where}: expires: it is not after not_before")
        last[each.name], serials[each.serial] = each.generation, number


def _table(each: Certificate) -> str:
    addresses = ", ".join(f'"{address}"' for address in each.addresses)
    return (
        f'[[certificate]]\nname = "{each.name}"\nrole = "{each.role}"\ngeneration = {each.generation}\n'
        f'serial = "{each.serial}"\nnot_before = {_time(each.not_before)}\nexpires = {_time(each.expires)}\n'
        f"addresses = [{addresses}]\nrevoked = {str(each.revoked).lower()}\n"
    )


def _time(when: datetime) -> str:
    return f"{when.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"
