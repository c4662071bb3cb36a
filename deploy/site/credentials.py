"""Credentials: a folder with ca.pem, cert.pem and key.pem, by which a machine or a person is known to the others.

`read` checks them before anything connects, since zenoh tells of wrong ones in its log alone. The folder is opened once
and its files are read from there: while it is replaced by the next generation, all are of the former or all are of the
next. Zenoh opens the files by their paths. A link that it makes in the moment of the exchange may get a key and a
certificate of two generations; it fails, and zenoh tries again.
"""

from __future__ import annotations

import os
import re
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from cocoro.errors import ConfigError
from deploy.site import files
from deploy.site.admitted import named, role_of
from deploy.site.authority import fingerprint
from deploy.site.place import CA_CERT, CERT, KEY
from deploy.site.roles import Role

TLS = "transport/link/tls"
COPY = "copy the whole folder again from the machine that issues"
_TRIES = 100


class Credentials(NamedTuple):
    """Credentials that were found to be good."""

    folder: Path
    name: str
    generation: int
    role: Role
    not_before: datetime
    expires: datetime
    authority: str
    """SHA-256 of the authority's certificate."""

    @property
    def common_name(self) -> str:
        return f"{self.name}.{self.generation}"

    @property
    def options(self) -> dict[str, Any]:
        """The options of a zenoh session, by path, for links with mutual TLS."""
        key, certificate = str(self.folder / KEY), str(self.folder / CERT)
        return {
            f"{TLS}/root_ca_certificate": str(self.folder / CA_CERT),
            f"{TLS}/listen_private_key": key,
            f"{TLS}/listen_certificate": certificate,
            f"{TLS}/connect_private_key": key,
            f"{TLS}/connect_certificate": certificate,
            f"{TLS}/enable_mtls": True,
            f"{TLS}/verify_name_on_connect": True,
            f"{TLS}/close_link_on_expiration": True,
        }


def read(
    folder: Path, now: datetime, *, name: str | None = None, role: Role | None = None, authority: str | None = None
) -> Credentials:
    """Reads and checks a folder of credentials. `name`, `role` and `authority` (as in admitted.toml) are what the
    certificate must say; None accepts any.

    Raises ConfigError for missing, damaged or foreign files, for a key that others may read, and for a certificate that
    is not valid at the time `now`.
    """
    folder = folder.absolute()
    ca_pem, cert_pem, key_pem = _files(folder)
    ca, certificate = _parsed(ca_pem, folder / CA_CERT), _parsed(cert_pem, folder / CERT)
    _check_key(key_pem, certificate, folder)
    _check_authority(ca, certificate, folder, authority)
    found = _found(certificate, folder, fingerprint(ca))
    where = folder / CERT
    if name is not None and found.name != name:
        raise ConfigError(f"{where}: it is the certificate of {found.name}, not of {name}: {COPY}")
    if role is not None and found.role != role:
        raise ConfigError(f"{where}: its role is {found.role}, not {role}: revoke it and issue it with that role")
    if now >= found.expires:
        raise ConfigError(f"{where}: it expired on {found.expires:%Y-%m-%d %H:%M} UTC: {_renewal(found.name)}")
    if now < found.not_before:
        raise ConfigError(
            f"{where}: it is not valid before {found.not_before:%Y-%m-%d %H:%M} UTC: is this machine's clock right?"
        )
    if now >= ca.not_valid_after_utc:
        raise ConfigError(f"{folder / CA_CERT}: the authority has expired: make a new one, and all certificates anew")
    return found


def _renewal(name: str) -> str:
    return f"`cocoro pki renew {name}` on the machine that issues, then copy the folder"


def _files(folder: Path) -> tuple[bytes, bytes, bytes]:
    """Authority, certificate and key, all from one folder, also while it is being replaced."""
    for _ in range(_TRIES):
        try:
            with files.opened(folder) as fd:
                files.must_be_private(folder, fd)
                held = os.fstat(fd)
                try:
                    return (
                        files.read_file(folder, fd, CA_CERT),
                        files.read_file(folder, fd, CERT),
                        files.read_file(folder, fd, KEY, secret=True),
                    )
                except FileNotFoundError as error:
                    if os.path.samestat(held, folder.stat()):
                        raise ConfigError(f"{folder / str(error.filename)} is missing: {COPY}") from None
        except FileNotFoundError:
            continue
    raise ConfigError(f"{folder}: it is replaced again and again: try again when that is over")


def _parsed(pem: bytes, path: Path) -> x509.Certificate:
    try:
        (found,) = x509.load_pem_x509_certificates(pem)
    except ValueError:
        raise ConfigError(f"{path}: it is damaged, or not one certificate in PEM: {COPY}") from None
    return found


def _check_key(pem: bytes, certificate: x509.Certificate, folder: Path) -> None:
    try:
        key = serialization.load_pem_private_key(pem, password=None)
    except TypeError:
        raise ConfigError(f"{folder / KEY}: it is encrypted, which zenoh cannot read: {COPY}") from None
    except (ValueError, UnsupportedAlgorithm):
        raise ConfigError(f"{folder / KEY}: it is damaged, or no private key in PEM: {COPY}") from None
    if key.public_key() != certificate.public_key():
        raise ConfigError(f"{folder}: {KEY} is not the key of {CERT}: {COPY}")


def _check_authority(ca: x509.Certificate, certificate: x509.Certificate, folder: Path, wanted: str | None) -> None:
    if wanted is not None and fingerprint(ca) != wanted:
        raise ConfigError(f"{folder / CA_CERT}: it is not the authority that admitted.toml names: {COPY}")
    try:
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm):
        raise ConfigError(f"{folder / CERT}: it is not of the authority in {CA_CERT}: {COPY}") from None


def _found(certificate: x509.Certificate, folder: Path, authority: str) -> Credentials:
    """What the certificate says. Raises ConfigError for one that `cocoro pki` has not made."""
    try:
        name, _, generation = _only(certificate, NameOID.COMMON_NAME).rpartition(".")
        role = role_of(_only(certificate, NameOID.ORGANIZATIONAL_UNIT_NAME))
        if not re.fullmatch(r"[1-9]\d{0,5}", generation, re.ASCII):
            raise ConfigError("no generation")
        named(name)
    except (ValueError, ConfigError):
        raise ConfigError(
            f"{folder / CERT}: it names no principal with a role: `cocoro pki issue` makes one that does"
        ) from None
    not_before, expires = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return Credentials(folder, name, int(generation), role, not_before, expires, authority)


def _only(certificate: x509.Certificate, what: x509.ObjectIdentifier) -> str:
    """The value of an attribute that the subject has once. Raises ValueError."""
    (attribute,) = certificate.subject.get_attributes_for_oid(what)
    return str(attribute.value)
