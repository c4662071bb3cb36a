"""The authority of a site: it issues the certificates by which machines and persons know one another.

Its private key lies in `authority/ca.key` of the site's folder, on the machine that issues and on no other. Each name
has a folder `credentials/NAME` with ca.pem, cert.pem and key.pem, to be copied to the machine of that name. What is
issued is written into admitted.toml before the credentials are put in place: no certificate exists that the file does
not name, and no generation is given twice. A new generation takes the place of the former folder in one step (see
`deploy.site.files`).

The certificates: EC keys on P-256, signed with SHA-256, for client and server; the common name is NAME.GENERATION, the
organisational unit the role, the alternative names the machine's addresses.
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import msgspec
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from cocoro.errors import ConfigError, RefusedError
from deploy.site import admitted, files
from deploy.site.admitted import Admitted, Certificate
from deploy.site.place import ADMITTED, AUTHORITY, CA_CERT, CA_KEY, CERT, CREDENTIALS, DAYS, KEY
from deploy.site.roles import Role

AUTHORITY_DAYS = 3650
SKEW = timedelta(hours=1)
"""A certificate is valid from this long ago on, for machines whose clocks are late."""
_DNS_NAME = re.compile(
    r"(?=.{1,253}\Z)[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?)*\Z"
)


class Issued(NamedTuple):
    """A certificate, and the folder with it and its key."""

    certificate: Certificate
    folder: Path


class _Authority(NamedTuple):
    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


def init(site: Path, now: datetime) -> datetime:
    """Makes the authority of a site and returns its expiry. Raises RefusedError when there is one, or when
    admitted.toml is of another; ConfigError when the site's folder is not safe."""
    with files.locked(site, make=True) as fd:
        if (site / AUTHORITY).exists() or (site / AUTHORITY).is_symlink():
            raise RefusedError(
                f"{site / AUTHORITY} is there already: issue certificates with `cocoro pki issue ROLE NAME`; a new "
                f"authority would make all of them invalid"
            )
        if (site / ADMITTED).exists() and admitted.read(site).certificate:
            raise RefusedError(
                f"{site / ADMITTED} names certificates of another authority: work on the machine that has it, or, if "
                f"it is lost, move that file away and issue all certificates anew"
            )
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _own_certificate(key, now)
        draft = files.Draft(site, fd, AUTHORITY)
        draft.write({CA_KEY: (_pem_of(key), files.PRIVATE), CA_CERT: (_pem(certificate), files.PUBLIC)})
        admitted.write(site, fd, Admitted(authority=fingerprint(certificate)))
        draft.put()
        return certificate.not_valid_after_utc


def issue(
    site: Path, role: Role, name: str, now: datetime, *, addresses: Iterable[str] = (), days: int = DAYS
) -> Issued:
    """Issues the first certificate of a name, or a new one after all were revoked; then its role may be another.

    Raises RefusedError when the name has one, ConfigError for a wrong name or address, or a damaged authority.
    """
    admitted.named(name)
    names = checked_addresses(addresses)
    with _opened(site) as (fd, authority, known):
        generation = 1
        if name in known.names:
            newest = known.newest(name)
            if not newest.revoked:
                raise RefusedError(
                    f"{name} has a certificate already ({newest.common_name}, {newest.role}): `cocoro pki renew "
                    f"{name}` makes the next one; to give it another role, revoke it first"
                )
            generation = newest.generation + 1
        return _issue(site, fd, authority, known, _Wish(name, role, generation, names, days, now))


def renew(site: Path, name: str, now: datetime, *, addresses: Iterable[str] | None = None, days: int = DAYS) -> Issued:
    """Issues the next certificate of a name, with its role and, without others, its addresses. The former one stays
    valid until it expires. Raises RefusedError when it is revoked, ConfigError for an unknown name and as `issue`."""
    admitted.named(name)
    with _opened(site) as (fd, authority, known):
        newest = known.newest(name)
        if newest.revoked:
            raise RefusedError(
                f"{newest.common_name} is revoked: `cocoro pki issue ROLE {name}` makes a new certificate"
            )
        names = newest.addresses if addresses is None else checked_addresses(addresses)
        wish = _Wish(name, newest.role, newest.generation + 1, names, days, now)
        return _issue(site, fd, authority, known, wish)


def revoke(site: Path, name: str) -> tuple[Certificate, ...]:
    """Revokes all certificates of a name, removes its credentials here, and returns the certificates that were not
    revoked before. Needs no key, but the machine that issues, so that admitted.toml is changed in one place. Raises
    RefusedError when all are revoked, ConfigError for an unknown name."""
    admitted.named(name)
    must_be_here(site)
    with files.locked(site) as fd:
        known = admitted.read(site)
        newest = known.newest(name)
        found = tuple(each for each in known.certificate if each.name == name and not each.revoked)
        if not found:
            raise RefusedError(f"{newest.common_name} is revoked already, and so are all before it")
        rows = (msgspec.structs.replace(each, revoked=each.revoked or each.name == name) for each in known.certificate)
        admitted.write(site, fd, msgspec.structs.replace(known, certificate=tuple(rows)))
        files.remove_folder(site / CREDENTIALS / name)
    return found


def fingerprint(certificate: x509.Certificate) -> str:
    """The SHA-256 of a certificate, by which admitted.toml names the authority."""
    return hashlib.sha256(certificate.public_bytes(serialization.Encoding.DER)).hexdigest()


def checked_addresses(addresses: Iterable[str]) -> tuple[str, ...]:
    """IP addresses and host names in their usual form, each once. Raises ConfigError for what is neither."""
    return tuple(dict.fromkeys(str(_alternative(address).value) for address in addresses))


def _alternative(address: str) -> x509.GeneralName:
    try:
        if "%" not in address:  # the zone of a link-local address
            return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        pass
    if re.search(r"[A-Za-z]", address) and _DNS_NAME.match(address):
        return x509.DNSName(address)
    raise ConfigError(f"--address {address}: it is neither an IP address (10.77.0.1) nor a name (base.local)")


class _Wish(NamedTuple):
    """What a certificate is to say."""

    name: str
    role: Role
    generation: int
    addresses: tuple[str, ...]
    days: int
    now: datetime


def _issue(site: Path, fd: int, authority: _Authority, known: Admitted, wish: _Wish) -> Issued:
    until = authority.certificate.not_valid_after_utc
    left = (until - wish.now).days
    if left < wish.days:
        advice = f"--days {left} at most" if left > 0 else "make a new authority, and all certificates anew"
        raise ConfigError(f"{site / AUTHORITY / CA_CERT}: the authority expires on {until:%Y-%m-%d}: {advice}")
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _certificate(authority, key.public_key(), wish)
    row = Certificate(
        name=wish.name, role=wish.role, generation=wish.generation, serial=f"{certificate.serial_number:x}",
        not_before=certificate.not_valid_before_utc, expires=certificate.not_valid_after_utc, addresses=wish.addresses,
    )  # fmt: skip
    folder = site / CREDENTIALS
    with files.opened(folder, make=True) as parent:
        draft = files.Draft(folder, parent, wish.name)
        draft.write({
            CA_CERT: (_pem(authority.certificate), files.PUBLIC),
            CERT: (_pem(certificate), files.PUBLIC),
            KEY: (_pem_of(key), files.PRIVATE),
        })  # fmt: skip
        try:
            admitted.write(site, fd, msgspec.structs.replace(known, certificate=(*known.certificate, row)))
        except BaseException:
            draft.drop()
            raise
        draft.put()
    return Issued(row, draft.path)


def _certificate(authority: _Authority, key: ec.EllipticCurvePublicKey, wish: _Wish) -> x509.Certificate:
    subject = x509.Name([
        x509.NameAttribute(NameOID.COMMON_NAME, f"{wish.name}.{wish.generation}"),
        x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, wish.role),
    ])  # fmt: skip
    builder = _begun(subject, authority.certificate.subject, key, wish.now, wish.days)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(signs=False), critical=True)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    builder = builder.add_extension(issuer, critical=False)
    if wish.addresses:
        names = x509.SubjectAlternativeName([_alternative(address) for address in wish.addresses])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(authority.key, hashes.SHA256())


def _own_certificate(key: ec.EllipticCurvePrivateKey, now: datetime) -> x509.Certificate:
    digest = x509.SubjectKeyIdentifier.from_public_key(key.public_key()).digest.hex()
    # The name differs from that of any other authority, so that a foreign certificate is refused as such.
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"cocoro authority {digest[:16]}")])
    builder = _begun(name, name, key.public_key(), now, AUTHORITY_DAYS)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    return builder.add_extension(_usage(signs=True), critical=True).sign(key, hashes.SHA256())


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    now = now.astimezone(UTC).replace(microsecond=0)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now - SKEW).not_valid_after(now + timedelta(days=days))
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)


def _usage(*, signs: bool) -> x509.KeyUsage:
    """What a key is for: the authority's signs certificates, another one handshakes."""
    return x509.KeyUsage(
        digital_signature=not signs, key_cert_sign=signs, crl_sign=signs, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _pem_of(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


@contextmanager
def _opened(site: Path) -> Iterator[tuple[int, _Authority, Admitted]]:
    """Locks the site's folder: its descriptor, the authority and who is admitted."""
    with files.locked(site) as fd:
        authority, known = _read(site / AUTHORITY), admitted.read(site)
        if fingerprint(authority.certificate) != known.authority:
            raise ConfigError(
                f"{site / ADMITTED}, authority: it is not that of {site / AUTHORITY}: put the two that belong together "
                f"into one folder"
            )
        yield fd, authority, known


def _read(folder: Path) -> _Authority:
    must_be_here(folder.parent)
    with files.opened(folder) as fd:
        files.must_be_private(folder, fd)
        try:
            key_pem = files.read_file(folder, fd, CA_KEY, secret=True)
            cert_pem = files.read_file(folder, fd, CA_CERT)
        except FileNotFoundError as error:
            raise ConfigError(
                f"{folder / str(error.filename)} is missing: put the authority's back from your copy"
            ) from None
    try:
        key = serialization.load_pem_private_key(key_pem, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise ConfigError(f"{folder / CA_KEY}: it is damaged, or no private key: put it back from your copy") from None
    try:
        certificate = x509.load_pem_x509_certificate(cert_pem)
    except ValueError:
        raise ConfigError(f"{folder / CA_CERT}: it is damaged, or no certificate: put it back from your copy") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise ConfigError(f"{folder / CA_KEY}: it is not the key of {CA_CERT}: put back the one that is")
    return _Authority(key, certificate)


def must_be_here(site: Path) -> None:
    """Raises ConfigError on a machine without the authority."""
    if not (site / AUTHORITY).exists():
        raise ConfigError(
            f"{site / AUTHORITY} is not here: give this command on the machine that issues the site's certificates, or "
            f"begin with `cocoro pki init`"
        )
