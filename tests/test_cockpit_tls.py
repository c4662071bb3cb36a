"""The cockpit beyond loopback: what is refused before it begins, and who is let in with a certificate or a code."""

from __future__ import annotations

import asyncio
import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import msgspec
import pytest
from cockpit_access_rig import Open, served
from test_cockpit_door import QUICK, Client, in_real_time, silent, until

from cocoro.errors import ConfigError
from deploy.site import authority
from services.cockpit.access import COOKIE, GateLimits
from services.cockpit.access_certificates import SiteCertificates
from services.cockpit.access_limits import Rate
from services.cockpit.access_passage import Passage
from services.cockpit.access_people import People, spaced
from services.cockpit.access_tls import Entrance, entrance
from services.cockpit.config import CockpitConfig

PLAN = """
name = "lab"
[robot.calliope]
profile = "sim"
[robot.other]
profile = "sim"
[host.body]
role = "robot"
robot = "calliope"
[person.ada]
role = "operator"
[person.eve]
role = "viewer"
[person.bob]
role = "author"
[person.mel]
role = "operator"
robots = ["other"]
"""
PEOPLE = {"ada": "operator", "eve": "viewer", "bob": "author", "mel": "operator", "zoe": "operator"}


class Lab:
    """A site with credentials for a machine and persons."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now = datetime.now(UTC)
        (folder / "site.toml").write_text(PLAN)
        (folder / "site.toml").chmod(0o644)
        authority.init(folder, self.now)
        authority.issue(folder, "robot", "body", self.now, addresses=("127.0.0.1", "localhost"))
        for name, role in PEOPLE.items():
            authority.issue(folder, role, name, self.now)  # type: ignore[arg-type]

    def of(self, name: str) -> Path:
        return self.folder / "credentials" / name

    def config(self, **more: Any) -> CockpitConfig:
        given = {"host": "0.0.0.0", "credentials": str(self.of("body")), "site": str(self.folder)} | more
        return msgspec.convert(given, CockpitConfig)

    def client(self, name: str | None) -> ssl.SSLContext:
        """TLS of a person, with his certificate or without one."""
        context = ssl.create_default_context(cafile=str(self.of("body") / "ca.pem"))
        if name is not None:
            context.load_cert_chain(self.of(name) / "cert.pem", self.of(name) / "key.pem")
        return context


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


@pytest.fixture
def own_lab(tmp_path: Path) -> Lab:
    """One that a test may change."""
    return Lab(tmp_path)


# --- configurations ----------------------------------------------------------------------------------


def refused(*parts: str, **given: Any) -> str:
    """A configuration is refused in one line that has all these parts."""
    with pytest.raises(ConfigError) as caught:
        entrance(msgspec.convert(given, CockpitConfig))
    text = str(caught.value)
    assert "\n" not in text
    assert all(part in text for part in parts), text
    return text


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.77.0.1", "192.168.1.5", "fe80::1"])
def test_a_cockpit_for_others_without_tls_is_refused(host: str) -> None:
    refused(host, "TLS", "ssh -L", "credentials", host=host)


@pytest.mark.parametrize("host", ["robot.local", "", "127.0.0.1:8770", "http://127.0.0.1", "256.1.1.1", "*"])
def test_a_host_that_is_no_address_is_refused(host: str) -> None:
    refused("host", "0.0.0.0", host=host)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "127.0.0.5"])
def test_loopback_needs_nothing(host: str) -> None:
    found = entrance(CockpitConfig(host=host))
    assert not found.beyond
    assert found.context() is None
    assert found.url(8770).startswith("http://")


def test_settings_that_contradict_each_other_are_named(lab: Lab) -> None:
    cert, key = str(lab.of("body") / "cert.pem"), str(lab.of("body") / "key.pem")
    refused("tls_cert", "without tls_key", tls_cert=cert)
    refused("tls_key", "without tls_cert", tls_key=key)
    refused("site", "without credentials", site=str(lab.folder))
    refused("names", "https://robot", names=["https://robot/"])
    refused("names", "robot:8770", names=["robot:8770"])
    refused("does not belong to", host="0.0.0.0", tls_cert=cert, tls_key=str(lab.of("ada") / "key.pem"))


def test_files_that_are_missing_or_damaged_are_named(lab: Lab, tmp_path: Path) -> None:
    good = {"tls_cert": str(lab.of("body") / "cert.pem"), "tls_key": str(lab.of("body") / "key.pem")}
    refused("nothing.pem", "No such file", host="0.0.0.0", **good | {"tls_cert": str(tmp_path / "nothing.pem")})
    refused("none", "No such file", host="0.0.0.0", credentials=str(tmp_path / "none"))
    bad = tmp_path / "bad.pem"
    bad.write_text("no certificate")
    bad.chmod(0o600)
    refused("bad.pem", "no certificate", host="0.0.0.0", **good | {"tls_cert": str(bad)})
    refused("bad.pem", "no private key", host="0.0.0.0", **good | {"tls_key": str(bad)})
    bad.write_bytes(Path(good["tls_key"]).read_bytes())
    bad.chmod(0o644)
    refused("bad.pem", "others may read", "chmod 600", host="0.0.0.0", **good | {"tls_key": str(bad)})
    bad.write_text("-----BEGIN ENCRYPTED PRIVATE KEY-----\n")
    bad.chmod(0o600)
    refused("bad.pem", "encrypted", host="0.0.0.0", **good | {"tls_key": str(bad)})
    refused("no address", "--address", host="0.0.0.0", credentials=str(lab.of("ada")))


def test_a_certificate_out_of_its_time_is_refused(lab: Lab) -> None:
    for days, what in ((-10, "not valid before"), (1000, "expired")):
        with pytest.raises(ConfigError, match=what):
            entrance(lab.config(), lab.now + timedelta(days=days))


def test_the_names_of_the_certificate_are_those_of_the_cockpit(lab: Lab) -> None:
    found = entrance(lab.config(names=["robot.local", "fd00::1"]))
    assert found.beyond
    assert {"localhost", "127.0.0.1", "robot.local", "fd00::1"} <= found.names
    assert found.url(1) == "https://robot.local:1/"
    assert entrance(lab.config(names=["fd00::1"])).url(1) == "https://[fd00::1]:1/"
    assert entrance(lab.config()).url(1) == "https://127.0.0.1:1/"


# --- certificates of persons --------------------------------------------------------------------------


async def get(
    cockpit: Open, context: ssl.SSLContext, path: str = "/", method: str = "GET", more: str = "", body: str = ""
) -> bytes:
    """The answer to one request over TLS; empty when the connection was refused."""
    asked = f"{method} {path} HTTP/1.1\r\nHost: localhost:{cockpit.port}\r\nConnection: close\r\n{more}\r\n{body}"
    try:
        streams = await asyncio.open_connection("127.0.0.1", cockpit.port, ssl=context, server_hostname="localhost")
        return await Client(*streams)(asked.encode())
    except (ssl.SSLError, ConnectionError):
        return b""


def remote(lab: Lab) -> dict[str, Any]:
    """What `served` needs to be reached as from another machine."""
    return {
        "entrance": entrance(lab.config()),
        "certificates": SiteCertificates(lab.folder, "calliope"),
        "door_limits": QUICK._replace(first_s=5.0),
    }


@pytest.fixture
def from_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """The door takes clients of this machine for those of another."""
    monkeypatch.setattr("services.cockpit.access_door.is_loopback", lambda _address: False)


@pytest.mark.usefixtures("from_elsewhere")
@in_real_time
async def test_persons_of_the_site_are_let_in_by_their_roles(lab: Lab) -> None:
    async with served(**remote(lab)) as cockpit:
        origin = f"Origin: https://localhost:{cockpit.port}\r\n"
        for name, looks, operates in (
            ("ada", b"200", b"200"), ("eve", b"200", b"403"), ("bob", b"200", b"403"),
            ("mel", b"303", b"401"), ("zoe", b"303", b"401"), ("body", b"303", b"401"), (None, b"303", b"401"),
        ):  # fmt: skip
            context = lab.client(name)
            assert (await get(cockpit, context))[9:12] == looks, name
            assert (await get(cockpit, context, "/run", "POST", origin))[9:12] == operates, name
        assert cockpit.audit.has("a viewer who wants to operate")


@in_real_time
async def test_this_machines_user_needs_no_certificate_and_no_code(lab: Lab) -> None:
    async with served(**remote(lab)) as cockpit:
        assert (await get(cockpit, lab.client(None), "/run", "POST"))[9:12] == b"200"


@pytest.mark.usefixtures("from_elsewhere")
@in_real_time
async def test_a_certificate_of_another_authority_is_refused(lab: Lab, tmp_path: Path) -> None:
    other = Lab(tmp_path)
    context = lab.client(None)
    context.load_cert_chain(other.of("ada") / "cert.pem", other.of("ada") / "key.pem")
    async with served(**remote(lab)) as cockpit:
        assert await get(cockpit, context) == b""
        await until(lambda: cockpit.audit.has("TLS handshake failed"))


@pytest.mark.usefixtures("from_elsewhere")
@in_real_time
async def test_a_revoked_certificate_and_a_changed_plan_take_effect_while_it_runs(own_lab: Lab) -> None:
    lab = own_lab
    given = remote(lab)
    given["certificates"] = SiteCertificates(lab.folder, "calliope", clock=iter(range(0, 10**6, 2)).__next__)
    async with served(**given) as cockpit:
        ada, eve = lab.client("ada"), lab.client("eve")
        assert (await get(cockpit, ada))[9:12] == b"200"
        authority.revoke(lab.folder, "ada")
        assert (await get(cockpit, ada))[9:12] == b"303"
        assert (await get(cockpit, eve))[9:12] == b"200"
        (lab.folder / "site.toml").write_text(PLAN.replace("eve", "eva"))
        assert (await get(cockpit, eve))[9:12] == b"303"
        authority.renew(lab.folder, "bob", lab.now)
        assert (await get(cockpit, lab.client("bob")))[9:12] == b"200"
        (lab.folder / "admitted.toml").write_text("nonsense = ")
        assert (await get(cockpit, lab.client("bob")))[9:12] == b"303"


def test_the_next_generation_is_known_before_the_new_file_has_come(own_lab: Lab) -> None:
    known = (own_lab.folder / "admitted.toml").read_bytes()
    certificates = SiteCertificates(own_lab.folder, "calliope", clock=iter(range(0, 10**6, 2)).__next__)

    def shown(generation: int, serial: str = "1234") -> dict[str, Any]:
        subject = ((("commonName", f"ada.{generation}"),), (("organizationalUnitName", "operator"),))
        return {"subject": subject, "serialNumber": serial, "notAfter": "Jan  1 00:00:00 2090 GMT"}

    authority.renew(own_lab.folder, "ada", own_lab.now)
    (own_lab.folder / "admitted.toml").write_bytes(known)
    assert certificates.visitor(shown(2)) == ("ada", "operator")
    assert certificates.visitor(shown(3)) is None
    assert certificates.visitor(shown(1)) is None  # not the serial number that was issued
    authority.revoke(own_lab.folder, "ada")
    assert certificates.visitor(shown(2)) is None


# --- codes ----------------------------------------------------------------------------------------------


def cookie_of(answer: bytes) -> str:
    """The cookie that an answer sets, with its attributes checked."""
    (line,) = [line for line in answer.split(b"\r\n") if line.lower().startswith(b"set-cookie:")]
    value, *attributes = line.decode().partition(": ")[2].split("; ")
    assert value.startswith(f"{COOKIE}=")
    assert {"Secure", "HttpOnly", "SameSite=Strict", "Path=/"} <= {*attributes}
    assert not any(each.startswith("Domain") for each in attributes)
    return value


async def log_in(cockpit: Open, lab: Lab, code: str) -> bytes:
    body = urlencode({"code": code})
    kind = f"Content-Type: application/x-www-form-urlencoded\r\nContent-Length: {len(body)}\r\n"
    origin = f"Origin: https://localhost:{cockpit.port}\r\n"
    return await get(cockpit, lab.client(None), "/login", "POST", kind + origin, body)


@pytest.mark.usefixtures("from_elsewhere")
@in_real_time
async def test_a_code_lets_in_from_elsewhere_once_with_its_role(lab: Lab, short_path: Path) -> None:
    people = People(short_path / "cockpit")
    async with served(**remote(lab), people=people) as cockpit:
        context = lab.client(None)
        assert b'name="code"' in await get(cockpit, context, "/login")
        assert b"form-action 'self'" in await get(cockpit, context, "/login")
        code = people.invite("viewer", "guest")
        answer = await log_in(cockpit, lab, spaced(code).lower())
        assert answer[9:12] == b"303"
        cookie = f"Cookie: {cookie_of(answer)}\r\n"
        origin = f"Origin: https://localhost:{cockpit.port}\r\n"
        assert (await get(cockpit, context, more=cookie))[9:12] == b"200"
        assert (await get(cockpit, context, "/stop", "POST", cookie + origin))[9:12] == b"200"
        assert (await get(cockpit, context, "/stop", "POST", cookie))[9:12] == b"403"  # a browser says its origin
        assert (await get(cockpit, context, "/run", "POST", cookie + origin))[9:12] == b"403"
        assert (await log_in(cockpit, lab, code))[9:12] == b"403"  # a second time
        assert cockpit.audit.has("no such code")
        assert (await get(cockpit, context, "/logout", "POST", cookie + origin))[9:12] == b"303"
        assert (await get(cockpit, context, more=cookie))[9:12] == b"303"  # the cookie is of no more use


@pytest.mark.usefixtures("from_elsewhere")
@in_real_time
async def test_codes_cannot_be_guessed_in_numbers(lab: Lab, short_path: Path) -> None:
    people = People(short_path / "cockpit")
    limits = GateLimits(logins=Rate(1e-6, 3.0))
    async with served(**remote(lab), people=people, gate_limits=limits) as cockpit:
        assert [(await log_in(cockpit, lab, f"{number:012}"))[9:12] for number in range(5)] == [b"403"] * 3 + [
            b"429"
        ] * 2
        assert (await log_in(cockpit, lab, people.invite("operator")))[9:12] == b"429"
        assert cockpit.audit.has("too many logins")


@pytest.mark.usefixtures("from_elsewhere")
@in_real_time
async def test_forged_cookies_let_in_nobody(lab: Lab, short_path: Path) -> None:
    people = People(short_path / "cockpit")
    people.invite("operator")
    for cookie in ("", "x", "../invited/x", "a" * 3000, "%00", '"', f"a; {COOKIE}=b", f"; cockpit={'A' * 43}"):
        async with served(**remote(lab), people=people) as cockpit:
            assert (await get(cockpit, lab.client(None), "/x", more=f"Cookie: {COOKIE}={cookie}\r\n"))[9:12] == b"401"


@in_real_time
async def test_no_one_logs_in_where_nothing_is_encrypted(short_path: Path) -> None:
    people = People(short_path / "cockpit")
    token, _ = people.log_in(people.invite("operator"), "here") or ("", None)
    async with served(Entrance("127.0.0.1", False, frozenset({"127.0.0.1"})), people=people) as cockpit:
        cockpit.door.audit = cockpit.audit
        from cockpit_access_rig import ask, head

        scope = head(headers=[("Cookie", f"{COOKIE}={token}")], client=("10.0.0.5", 1))
        assert cockpit.gate.looked_up(scope) is None
        assert (await ask(Passage(cockpit.gate, cockpit.echo), scope)).status == 403


@in_real_time
async def test_half_done_handshakes_are_few_and_end(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    async with served(**remote(lab)) as cockpit:
        with monkeypatch.context() as patch:  # not for the person below, whose handshake may be slow
            patch.setattr("services.cockpit.access_door.HANDSHAKE_S", 0.3)
            async with silent(cockpit, 30):
                await until(lambda: cockpit.audit.has("too many handshakes"))
                await until(lambda: not cockpit.taken())
        assert cockpit.audit.has("TLS handshake failed")
        assert (await get(cockpit, lab.client("ada")))[9:12] == b"200"
