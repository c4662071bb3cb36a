"""How the cockpit is reached, by its configuration: from this machine alone, or from others with TLS.

Whatever would open it to others without TLS, or with a certificate that cannot work, is refused here in one line.
"""

from __future__ import annotations

import ipaddress
import os
import ssl
import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple, Protocol

from cocoro.errors import ConfigError
from services.cockpit.access_rules import LOOPBACK_NAMES, host_name

TABLE = "[service.cockpit]"
CA, CERT, KEY = "ca.pem", "cert.pem", "key.pem"
"""Files of a folder of credentials, as `cocoro pki` makes them."""
WAYS = (
    "from elsewhere use `ssh -L 8770:127.0.0.1:8770`, or give `credentials` (a folder of `cocoro pki`) or `tls_cert` "
    "and `tls_key`"
)


class Settings(Protocol):
    """What this module reads of the cockpit's configuration."""

    @property
    def host(self) -> str: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def tls_cert(self) -> str: ...
    @property
    def tls_key(self) -> str: ...
    @property
    def credentials(self) -> str: ...
    @property
    def site(self) -> str: ...


class Served(NamedTuple):
    """The files of the certificate that the cockpit shows."""

    cert: Path
    key: Path
    expires: datetime
    names: frozenset[str]
    """Host names and addresses that it is for, in small letters."""

    def stamp(self) -> tuple[int, ...]:
        """What changes when the files are replaced. Raises OSError."""
        return tuple(
            number for path in (self.cert, self.key) for number in (path.stat().st_mtime_ns, path.stat().st_ino)
        )


class Entrance(NamedTuple):
    """How the cockpit is reached."""

    host: str
    """The address to listen at."""
    beyond: bool
    """Whether other machines reach it."""
    names: frozenset[str]
    served: Served | None = None
    ca: Path | None = None
    """The authority of clients' certificates."""

    def url(self, port: int) -> str:
        """Where a person opens the page."""
        scheme = "http" if self.served is None else "https"
        host = self.host
        if ipaddress.ip_address(host).is_unspecified and self.served is not None:
            others = (self.names | self.served.names) - LOOPBACK_NAMES
            host = min(others, key=lambda name: (_is_address(name), name), default="127.0.0.1")
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"

    def context(self) -> ssl.SSLContext | None:
        """TLS for the listener; None without. Raises ConfigError."""
        if self.served is None:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        try:
            context.load_cert_chain(self.served.cert, self.served.key)
        except (OSError, ValueError) as error:  # of which ssl.SSLError is one
            what = getattr(error, "reason", None) or error
            raise ConfigError(f"{self.served.key} does not belong to {self.served.cert}: {what}") from error
        if self.ca is not None:
            try:
                context.load_verify_locations(self.ca)
            except (OSError, ValueError) as error:
                raise ConfigError(f"{self.ca}: it is no authority's certificate: {error}") from error
            context.verify_mode = ssl.CERT_OPTIONAL
        return context


def entrance(settings: Settings, now: datetime | None = None) -> Entrance:
    """How the cockpit is reached. Raises ConfigError for what contradicts itself, is not safe, or cannot work."""
    host = _host(settings.host)
    beyond = not ipaddress.ip_address(host).is_loopback
    if bool(settings.tls_cert) != bool(settings.tls_key):
        given, missing = ("tls_cert", "tls_key") if settings.tls_cert else ("tls_key", "tls_cert")
        raise ConfigError(f"{TABLE} {given} is given without {missing}: give both, or neither")
    if settings.site and not settings.credentials:
        raise ConfigError(f"{TABLE} site is given without credentials: its clients are verified by the ca.pem in them")
    own = set(LOOPBACK_NAMES) | {_name(name) for name in settings.names}
    if not ipaddress.ip_address(host).is_unspecified:
        own.add(host)
    if not settings.tls_cert and not settings.credentials:
        if beyond:
            what = "everybody on the network could read and change what passes"
            raise ConfigError(f"{TABLE} host = {settings.host!r} without TLS: {what}; {WAYS}")
        return Entrance(host, False, frozenset(own))
    folder = Path(settings.credentials)
    cert = Path(settings.tls_cert) if settings.tls_cert else folder / CERT
    key = Path(settings.tls_key) if settings.tls_key else folder / KEY
    served = _served(cert, key, now or datetime.now(UTC))
    if beyond and not served.names and not settings.names:
        raise ConfigError(
            f"{cert}: it names no address, so no browser takes it: `cocoro pki renew NAME --address ...` makes one "
            f"that does"
        )
    found = Entrance(host, beyond, frozenset(own | served.names), served, folder / CA if settings.site else None)
    found.context()
    return found


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _host(text: str) -> str:
    """Raises ConfigError for what is no address of this machine's."""
    if text == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise ConfigError(
            f"{TABLE} host = {text!r} is no address: give 127.0.0.1, an address of this machine, or 0.0.0.0 for all"
        ) from None


def _name(text: str) -> str:
    """A name of `names` in its usual form. Raises ConfigError."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        name = host_name(text)
    if name is None or ":" in text:
        raise ConfigError(f"{TABLE} names: {text!r} is no host name and no address; give it without scheme and port")
    return name


def _served(cert: Path, key: Path, now: datetime) -> Served:
    """Raises ConfigError."""
    try:
        from cryptography import x509
    except ModuleNotFoundError as error:
        raise ConfigError(f"{TABLE} TLS needs cryptography: pip install 'cocoro-mesh[site]'") from error
    pem = _bytes(cert)
    try:
        found = x509.load_pem_x509_certificates(pem)[0]
    except (ValueError, IndexError):
        raise ConfigError(f"{cert}: it is no certificate in PEM") from None
    expires, begins = found.not_valid_after_utc, found.not_valid_before_utc
    if now >= expires:
        raise ConfigError(f"{cert}: it expired on {expires:%Y-%m-%d %H:%M} UTC: renew it")
    if now < begins:
        raise ConfigError(f"{cert}: it is not valid before {begins:%Y-%m-%d %H:%M} UTC: is this machine's clock right?")
    held = _bytes(key, stated=True)
    if b"PRIVATE KEY" not in held:
        raise ConfigError(f"{key}: it is no private key in PEM")
    if b"ENCRYPTED" in held:
        raise ConfigError(f"{key}: it is encrypted, and nobody is there to type its password: give one that is not")
    names: set[str] = set()
    try:
        row = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        names |= {name.lower() for name in row.get_values_for_type(x509.DNSName) if not name.startswith("*")}
        names |= {str(address) for address in row.get_values_for_type(x509.IPAddress)}
    except x509.ExtensionNotFound:
        pass
    return Served(cert, key, expires, frozenset(names))


def _bytes(path: Path, *, stated: bool = False) -> bytes:
    """A file's content; `stated`: it is a secret. Raises ConfigError."""
    try:
        with path.open("rb") as file:
            held = os.fstat(file.fileno())
            if stated and (held.st_uid not in (0, os.geteuid()) or stat.S_IMODE(held.st_mode) & 0o077):
                raise ConfigError(f"{path}: others may read this private key: chmod 600 {path}")
            return file.read(1_000_000)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
