"""Credentials: good ones join by TLS in both directions; wrong, damaged and foreign ones are refused in words."""

from __future__ import annotations

import os
import shutil
import ssl
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from site_rig import ADDRESS, DAY, NOW, context, handshake

from cocoro.errors import ConfigError
from deploy.site import admitted, authority, credentials

TODAY = datetime.now(UTC)
"""The libraries of TLS look at the machine's clock."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sites; in the first three machines, one of which has expired."""
    place = tmp_path_factory.mktemp("sites")
    long_ago = TODAY - 400 * DAY
    authority.init(place / "lab", long_ago)
    authority.init(place / "other", long_ago)
    for name in ("base", "brain"):
        authority.issue(place / "lab", "robot", name, TODAY, addresses=[ADDRESS, "::1", "base.local"])
    authority.issue(place / "lab", "robot", "late", long_ago, addresses=[ADDRESS])
    authority.issue(place / "other", "robot", "base", TODAY, addresses=[ADDRESS])
    return place


@pytest.fixture
def lab(made: Path, tmp_path: Path) -> Path:
    """The first site, to be damaged."""
    return shutil.copytree(made / "lab", tmp_path / "lab")


# --- handshakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("address", [ADDRESS, "::1", "base.local"])
@pytest.mark.parametrize(("listens", "connects"), [("base", "brain"), ("brain", "base")])
def test_two_machines_of_a_site_know_one_another(made: Path, listens: str, connects: str, address: str) -> None:
    folder = made / "lab" / "credentials"
    server, client = context(folder / listens, server=True), context(folder / connects, server=False)
    assert handshake(server, client, address) == (f"{connects}.1", f"{listens}.1")


def test_the_next_generation_and_the_former_know_one_another(lab: Path, tmp_path: Path) -> None:
    former = shutil.copytree(lab / "credentials" / "base", tmp_path / "former")
    authority.renew(lab, "base", TODAY)
    brain = lab / "credentials" / "brain"
    for folder, common_name in ((former, "base.1"), (lab / "credentials" / "base", "base.2")):
        assert handshake(context(brain, server=True), context(folder, server=False))[0] == common_name
        assert handshake(context(folder, server=True), context(brain, server=False))[1] == common_name


def test_an_address_that_the_certificate_does_not_have_is_refused(made: Path) -> None:
    folder = made / "lab" / "credentials"
    with pytest.raises(ssl.SSLCertVerificationError, match="10\\.77\\.0\\.9"):
        handshake(context(folder / "base", server=True), context(folder / "brain", server=False), "10.77.0.9")


@pytest.mark.parametrize("who", ["foreign", "expired", "none"])
def test_a_stranger_is_refused_as_client_and_as_server(made: Path, who: str) -> None:
    lab = made / "lab" / "credentials"
    stranger = {"foreign": made / "other" / "credentials" / "base", "expired": lab / "late", "none": None}[who]
    ca = lab / "base" / "ca.pem"
    with pytest.raises(ssl.SSLError):
        handshake(context(lab / "base", server=True), context(stranger, server=False, ca=ca))
    with pytest.raises(ssl.SSLError):
        handshake(context(stranger, server=True, ca=ca), context(lab / "base", server=False))


# --- what they say ----------------------------------------------------------------------------------


def test_good_credentials_say_who_they_are_and_are_options_of_zenoh(made: Path) -> None:
    folder = made / "lab" / "credentials" / "base"
    known = admitted.read(made / "lab")
    found = credentials.read(folder, TODAY, name="base", role="robot", authority=known.authority)
    assert (found.name, found.generation, found.role, found.common_name) == ("base", 1, "robot", "base.1")
    assert found.expires == known.newest("base").expires
    options = {path.removeprefix("transport/link/tls/"): value for path, value in found.options.items()}
    assert options == {
        "root_ca_certificate": str(folder / "ca.pem"),
        "listen_private_key": str(folder / "key.pem"),
        "listen_certificate": str(folder / "cert.pem"),
        "connect_private_key": str(folder / "key.pem"),
        "connect_certificate": str(folder / "cert.pem"),
        "enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True,
    }  # fmt: skip


def test_their_key_is_in_no_text_that_is_printed(made: Path) -> None:
    folder = made / "lab" / "credentials" / "base"
    found = credentials.read(folder, TODAY)
    secret = (folder / "key.pem").read_text().splitlines()[1]
    assert secret not in repr(found) + repr(found.options)


@pytest.mark.parametrize(
    ("expected", "words"),
    [
        ({"name": "brain"}, "certificate of base, not of brain"),
        ({"role": "brain"}, "role is robot, not brain"),
        ({"authority": "ab" * 32}, "not the authority that admitted.toml names"),
    ],
)
def test_those_of_another_are_refused(made: Path, expected: dict[str, str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        credentials.read(made / "lab" / "credentials" / "base", TODAY, **expected)  # type: ignore[arg-type]


def test_they_are_refused_before_and_after_their_time(tmp_path: Path) -> None:
    authority.init(tmp_path / "lab", NOW)
    folder = authority.issue(tmp_path / "lab", "viewer", "ada", NOW, days=10).folder
    second = timedelta(seconds=1)
    credentials.read(folder, NOW - timedelta(hours=1))
    credentials.read(folder, NOW + 10 * DAY - second)
    with pytest.raises(ConfigError, match="clock"):
        credentials.read(folder, NOW - timedelta(hours=1) - second)
    with pytest.raises(ConfigError, match=r"expired on 2031-05-11 .*cocoro pki renew ada"):
        credentials.read(folder, NOW + 10 * DAY)


# --- permissions and damage -------------------------------------------------------------------------

FILES = ("ca.pem", "cert.pem", "key.pem")


def refused(folder: Path, *words: str) -> None:
    """The credentials are refused in one sentence with these words and nothing of the key."""
    with pytest.raises(ConfigError) as caught:
        credentials.read(folder, TODAY)
    for word in (str(folder), *words):
        assert word in str(caught.value)
    assert "PRIVATE KEY" not in str(caught.value)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o601])
def test_a_key_that_others_may_read_is_refused_with_the_command_that_helps(lab: Path, mode: int) -> None:
    folder = lab / "credentials" / "base"
    (folder / "key.pem").chmod(mode)
    refused(folder, f"chmod 600 {folder / 'key.pem'}")


@pytest.mark.parametrize("mode", [0o750, 0o755, 0o770])
def test_a_folder_that_others_may_look_into_is_refused(lab: Path, mode: int) -> None:
    folder = lab / "credentials" / "base"
    folder.chmod(mode)
    refused(folder)


def test_certificates_that_others_may_change_are_refused(lab: Path) -> None:
    folder = lab / "credentials" / "base"
    (folder / "ca.pem").chmod(0o666)
    refused(folder, f"chmod 644 {folder / 'ca.pem'}")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files to another user")
@pytest.mark.parametrize("file", [*FILES, "."])
def test_files_of_another_user_are_refused(lab: Path, file: str) -> None:
    folder = lab / "credentials" / "base"
    os.chown(folder / file, 65534, -1)
    refused(folder, "belongs to")


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("kind", ["missing", "link", "folder", "pipe", "empty", "cut", "zeros", "huge", "text"])
def test_damage_of_each_file_is_named(lab: Path, file: str, kind: str) -> None:
    folder = lab / "credentials" / "base"
    path = folder / file
    whole = path.read_bytes()
    path.unlink()
    makers: dict[str, Callable[[], object]] = {
        "missing": lambda: None,
        "link": lambda: path.symlink_to(lab / "credentials" / "brain" / file),
        "folder": path.mkdir,
        "pipe": lambda: os.mkfifo(path, 0o600),
        "empty": lambda: path.write_bytes(b""),
        "cut": lambda: path.write_bytes(whole[: len(whole) // 2]),
        "zeros": lambda: path.write_bytes(bytes(len(whole))),
        "huge": lambda: path.write_bytes(whole + b"x" * 5_000_000),
        "text": lambda: path.write_bytes(whole.replace(whole[60:70], b"!!!!!!!!!!")),
    }
    makers[kind]()
    if kind not in ("missing", "link", "folder", "pipe"):
        path.chmod(0o600)
    refused(folder, file)


def test_a_missing_folder_is_named(lab: Path) -> None:
    refused(lab / "credentials" / "nobody", "no such folder")


@pytest.mark.parametrize("file", ["cert.pem", "key.pem"])
def test_a_key_and_a_certificate_that_do_not_fit_are_refused(lab: Path, file: str) -> None:
    folder = lab / "credentials" / "base"
    shutil.copy(lab / "credentials" / "brain" / file, folder / file)
    refused(folder, "key.pem is not the key of cert.pem", "copy the whole folder again")


def test_a_foreign_authority_is_refused(lab: Path, made: Path) -> None:
    folder = lab / "credentials" / "base"
    shutil.copy(made / "other" / "credentials" / "base" / "ca.pem", folder / "ca.pem")
    refused(folder, "cert.pem: it is not of the authority in ca.pem")


def test_a_key_with_a_password_is_refused(lab: Path) -> None:
    path = lab / "credentials" / "base" / "key.pem"
    key = serialization.load_pem_private_key(path.read_bytes(), None)
    path.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    refused(path.parent, "encrypted")


def test_the_authoritys_own_certificate_is_nobodys(lab: Path) -> None:
    folder = lab / "credentials" / "base"
    shutil.copy(lab / "authority" / "ca.pem", folder / "cert.pem")
    shutil.copy(lab / "authority" / "ca.key", folder / "key.pem")
    refused(folder, "names no principal")
