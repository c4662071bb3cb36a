"""`cocoro pki`: certificates of a site's machines and persons."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.cli import completions
from apps.cli.options import JsonOption, SiteOption
from apps.cli.output import print_json, tell
from cocoro.errors import ConfigError
from deploy.site import place

if TYPE_CHECKING:
    from deploy.site.admitted import Certificate
    from deploy.site.authority import Issued

app = typer.Typer()
pki = typer.Typer(no_args_is_help=True, help="Issue, renew and revoke the certificates of a site; list them.")
app.add_typer(pki, name="pki")

NameArgument = Annotated[
    str, typer.Argument(metavar="NAME", autocompletion=completions.principals, help="A name that has a certificate.")
]
DaysOption = Annotated[
    int, typer.Option("--days", min=1, max=3650, metavar="N", help="Days for which the certificate is valid.")
]
AddressOption = Annotated[
    list[str] | None,
    typer.Option(
        "--address",
        metavar="ADDRESS",
        help="IP address or name at which others connect to this machine. Repeatable. By default those of the plan; "
        "`renew` keeps the former ones.",
    ),
]


@pki.command()
def init(site: SiteOption = None, json: JsonOption = False) -> None:
    """Make the authority that issues the certificates of a site; once, on one machine."""
    from deploy.site import authority

    folder = place.folder(site)
    expires = authority.init(folder, _now())
    key = folder / place.AUTHORITY / place.CA_KEY
    data = {
        "authority": str(folder / place.AUTHORITY),
        "admitted": str(folder / place.ADMITTED),
        "expires": _iso(expires),
    }
    tell(
        json,
        data,
        f"{key.parent}: the authority, until {expires:%Y-%m-%d}. Whoever has {key} can become any machine of the site: "
        f"leave it on this machine, and keep a copy in a safe.\nNext: cocoro pki issue ROLE NAME",
    )


@pki.command()
def issue(
    role: Annotated[
        str,
        typer.Argument(
            metavar="ROLE", autocompletion=completions.roles, help="robot, brain, hub, operator, viewer or author."
        ),
    ],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the machine or person: base, ada.")],
    days: DaysOption = place.DAYS,
    address: AddressOption = None,
    site: SiteOption = None,
    json: JsonOption = False,
) -> None:
    """Issue the certificate of a machine or person that has none."""
    from deploy.site import admitted, authority

    asked = admitted.role_of(role), admitted.named(name)
    folder, now = place.folder(site), _now()
    addresses = _planned(folder, *asked) if address is None else address
    _tell_issued(authority.issue(folder, *asked, now, addresses=addresses, days=days), now, json)


@pki.command()
def renew(
    name: NameArgument,
    days: DaysOption = place.DAYS,
    address: AddressOption = None,
    site: SiteOption = None,
    json: JsonOption = False,
) -> None:
    """Issue the next certificate of a name, with a new key. The former one stays valid until it expires."""
    from deploy.site import admitted, authority

    now, named = _now(), admitted.named(name)
    _tell_issued(authority.renew(place.folder(site), named, now, addresses=address or None, days=days), now, json)


@pki.command()
def revoke(name: NameArgument, site: SiteOption = None, json: JsonOption = False) -> None:
    """Revoke all certificates of a name. A machine of the site refuses them when it has got the new admitted.toml."""
    from deploy.site import admitted, authority

    folder = place.folder(site)
    revoked = [each.common_name for each in authority.revoke(folder, admitted.named(name))]
    text = f"{', '.join(revoked)}: revoked. Copy {folder / place.ADMITTED} to every machine of the site now"
    tell(json, {"revoked": revoked, "admitted": str(folder / place.ADMITTED)}, text)


@pki.command("list")
def list_certificates(site: SiteOption = None, json: JsonOption = False) -> None:
    """The certificates of the site: name, role, generation, expiry, and whether they are revoked."""
    from apps.cli.terminal import Column, print_table
    from deploy.site import admitted

    now, folder = _now(), place.folder(site)
    found = admitted.read(folder).certificate
    if json:
        print_json([_row(each, now) for each in found])
    elif not found:
        print(f"no certificates in {folder / place.ADMITTED}: `cocoro pki issue ROLE NAME` issues one")
    else:
        columns = (
            Column("name"), Column("role"), Column("generation", right=True), Column("expires"),
            Column("days left", right=True), Column("state"), Column("addresses", 1),
        )  # fmt: skip
        print_table(columns, [_cells(each, now) for each in found])


def _planned(folder: Path, role: str, name: str) -> tuple[str, ...]:
    """The addresses at which a name listens by the site's plan, if there is one. Raises ConfigError when the plan gives
    it another role."""
    from deploy.site import plan

    if not (folder / place.PLAN).is_file():
        return ()
    site = plan.read(folder)
    if name in site.principals and site.role(name) != role:
        raise ConfigError(f"{name} is {site.role(name)} by {folder / place.PLAN}, not {role}")
    return site.addresses(name)


def _tell_issued(issued: Issued, now: datetime, as_json: bool) -> None:
    certificate = issued.certificate
    data = _row(certificate, now) | {"folder": str(issued.folder)}
    admitted = issued.folder.parent.parent / place.ADMITTED
    at = f", at {', '.join(certificate.addresses)}" if certificate.addresses else ""
    text = (
        f"{certificate.common_name}: {certificate.role}{at}, until {certificate.expires:%Y-%m-%d} "
        f"({certificate.days_left(now)} days), in {issued.folder}\n"
        f"Copy that folder to {certificate.name} and to nobody else, and {admitted} to every machine of the site"
    )
    tell(as_json, data, text)


def _row(certificate: Certificate, now: datetime) -> dict[str, Any]:
    return {
        "name": certificate.name,
        "role": certificate.role,
        "generation": certificate.generation,
        "common_name": certificate.common_name,
        "serial": certificate.serial,
        "not_before": _iso(certificate.not_before),
        "expires": _iso(certificate.expires),
        "days_left": certificate.days_left(now),
        "addresses": list(certificate.addresses),
        "revoked": certificate.revoked,
        "state": _state(certificate, now),
    }


def _cells(certificate: Certificate, now: datetime) -> tuple[str, ...]:
    return (
        certificate.name,
        certificate.role,
        str(certificate.generation),
        f"{certificate.expires:%Y-%m-%d}",
        str(max(certificate.days_left(now), 0)),
        _state(certificate, now),
        " ".join(certificate.addresses),
    )


def _state(certificate: Certificate, now: datetime) -> str:
    if certificate.revoked:
        return "revoked"
    return "valid" if certificate.is_valid(now) else "expired"


def _iso(when: datetime) -> str:
    return f"{when.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)
