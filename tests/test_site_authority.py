"""The authority of a site: what it issues, renews, revokes and refuses, and what an interruption leaves."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from site_rig import ADDRESS, DAY, NOW

from cocoro.errors import ConfigError, RefusedError
from deploy.site import admitted, authority, credentials, files


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A site with an authority and one machine."""
    folder = tmp_path / "lab"
    authority.init(folder, NOW)
    authority.issue(folder, "robot", "base", NOW, addresses=[ADDRESS])
    return folder


def certificate_of(folder: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())


def modes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mode & 0o777 for path in folder.rglob("*")}


def test_the_folders_of_a_site_have_the_modes_of_what_they_hold(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        authority.init(tmp_path / "lab", NOW)
        authority.issue(tmp_path / "lab", "robot", "base", NOW)
    finally:
        os.umask(before)
    assert modes(tmp_path / "lab") == {
        "admitted.toml": 0o644,
        "authority": 0o700, "authority/ca.key": 0o600, "authority/ca.pem": 0o644,
        "credentials": 0o700, "credentials/base": 0o700,
        "credentials/base/ca.pem": 0o644, "credentials/base/cert.pem": 0o644, "credentials/base/key.pem": 0o600,
    }  # fmt: skip


def test_a_certificate_says_who_it_is_for_what_and_how_long(site: Path) -> None:
    found = certificate_of(site / "credentials" / "base")
    row = admitted.read(site).newest("base")
    assert found.subject.rfc4514_string() == "OU=robot,CN=base.1"
    assert found.not_valid_before_utc == row.not_before == NOW - timedelta(hours=1)
    assert found.not_valid_after_utc == row.expires == NOW + 90 * DAY
    assert f"{found.serial_number:x}" == row.serial
    assert found.signature_hash_algorithm is not None
    assert found.signature_hash_algorithm.name == "sha256"
    names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(each) for each in names.get_values_for_type(x509.IPAddress)] == [ADDRESS] == list(row.addresses)
    assert not found.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    purposes = found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert [purpose.dotted_string for purpose in purposes] == ["1.3.6.1.5.5.7.3.2", "1.3.6.1.5.5.7.3.1"]


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["10.77.0.1", "10.77.0.1"], ("10.77.0.1",)),
        (["FE80:0::1", "base.local", "base"], ("fe80::1", "base.local", "base")),
    ],
)
def test_addresses_are_kept_in_their_usual_form(site: Path, given: list[str], kept: tuple[str, ...]) -> None:
    assert authority.issue(site, "brain", "brain", NOW, addresses=given).certificate.addresses == kept
    assert admitted.read(site).newest("brain").addresses == kept


@pytest.mark.parametrize(
    "address",
    ["", "10.77.0", "10.77.0.256", "fe80::1%eth0", "*.local", "-x.local", "a b", "base\n", 'x"', "a..b", "é.x"],
)
def test_an_address_that_is_none_is_refused(site: Path, address: str) -> None:
    with pytest.raises(ConfigError, match="--address"):
        authority.issue(site, "brain", "brain", NOW, addresses=[address])
    assert admitted.read(site).names == ("base",)


def test_renewal_makes_the_next_generation_with_a_new_key_and_keeps_the_former_valid(site: Path) -> None:
    folder = site / "credentials" / "base"
    before = (folder / "key.pem").read_bytes()
    later = NOW + 80 * DAY
    issued = authority.renew(site, "base", later)
    assert issued.certificate.common_name == "base.2"
    assert issued.certificate.addresses == (ADDRESS,)
    assert issued.folder == folder
    assert (folder / "key.pem").read_bytes() != before
    assert credentials.read(folder, later, name="base", role="robot").generation == 2
    assert admitted.read(site).valid(later) == ("base.1", "base.2", "base.3")
    assert admitted.read(site).valid(NOW + 90 * DAY) == ("base.2", "base.3")
    assert [path.name for path in folder.parent.iterdir()] == ["base"]


def test_renewal_changes_addresses_when_it_is_given_some(site: Path) -> None:
    assert authority.renew(site, "base", NOW, addresses=["10.9.9.9"]).certificate.addresses == ("10.9.9.9",)


def test_a_revoked_name_loses_its_credentials_and_may_be_issued_anew_with_another_role(site: Path) -> None:
    authority.renew(site, "base", NOW)
    assert [each.common_name for each in authority.revoke(site, "base")] == ["base.1", "base.2"]
    assert admitted.read(site).valid(NOW) == ()
    assert not (site / "credentials" / "base").exists()
    with pytest.raises(RefusedError, match="revoked: `cocoro pki issue"):
        authority.renew(site, "base", NOW)
    with pytest.raises(RefusedError, match="already"):
        authority.revoke(site, "base")
    issued = authority.issue(site, "viewer", "base", NOW)
    assert (issued.certificate.common_name, issued.certificate.role) == ("base.3", "viewer")
    assert admitted.read(site).valid(NOW) == ("base.3", "base.4")


def test_what_is_asked_twice_is_refused_with_advice_and_changes_nothing(site: Path) -> None:
    before = {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}
    with pytest.raises(RefusedError, match="cocoro pki issue ROLE NAME"):
        authority.init(site, NOW)
    with pytest.raises(RefusedError, match="cocoro pki renew base"):
        authority.issue(site, "robot", "base", NOW)
    assert {path: path.read_bytes() for path in site.rglob("*") if path.is_file()} == before


def test_an_authority_is_not_made_over_the_certificates_of_another(site: Path) -> None:
    (site / "authority").rename(site / "elsewhere")
    with pytest.raises(RefusedError, match="another authority"):
        authority.init(site, NOW)
    with pytest.raises(ConfigError, match="authority is not here"):
        authority.issue(site, "robot", "other", NOW)
    with pytest.raises(ConfigError, match="authority is not here"):
        authority.revoke(site, "base")


def test_an_authority_and_an_admitted_file_that_do_not_belong_together_are_refused(site: Path, tmp_path: Path) -> None:
    authority.init(tmp_path / "other", NOW)
    (site / "admitted.toml").replace(tmp_path / "other" / "admitted.toml")
    with pytest.raises(ConfigError, match="belong together"):
        authority.issue(tmp_path / "other", "robot", "base2", NOW)
    with pytest.raises(ConfigError, match=r"admitted\.toml is missing"):
        authority.issue(site, "robot", "base2", NOW)


def test_no_certificate_outlives_the_authority(site: Path) -> None:
    late = NOW + 3600 * DAY
    with pytest.raises(ConfigError, match="--days 50 at most"):
        authority.renew(site, "base", late)
    assert authority.renew(site, "base", late, days=50).certificate.expires == NOW + 3650 * DAY
    with pytest.raises(ConfigError, match="make a new authority"):
        authority.renew(site, "base", NOW + 3650 * DAY)


@pytest.mark.parametrize("name", ["../x", "-x", "x\ny", ".x", ""])
def test_a_hostile_name_makes_no_file(site: Path, tmp_path: Path, name: str) -> None:
    before = sorted(tmp_path.rglob("*"))
    calls: tuple[Callable[[], Any], ...] = (
        lambda: authority.issue(site, "robot", name, NOW),
        lambda: authority.renew(site, name, NOW),
        lambda: authority.revoke(site, name),
    )
    for call in calls:
        with pytest.raises(ConfigError, match="small letters"):
            call()
    assert sorted(tmp_path.rglob("*")) == before


def test_one_command_at_a_time_changes_a_site(site: Path) -> None:
    with files.locked(site), pytest.raises(RefusedError, match="try again"):
        authority.renew(site, "base", NOW)


# --- damage -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("ca.key", b"", "ca.key: it is damaged"),
        ("ca.key", b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n", "ca.key: it is damaged"),
        ("ca.key", None, "ca.key is missing"),
        ("ca.pem", b"nonsense", "ca.pem: it is damaged"),
        ("ca.pem", None, "ca.pem is missing"),
    ],
)
def test_a_damaged_authority_is_named(site: Path, file: str, content: bytes | None, words: str) -> None:
    path = site / "authority" / file
    path.unlink() if content is None else path.write_bytes(content)
    path.parent.chmod(0o700)
    if content is not None and file == "ca.key":
        path.chmod(0o600)
    with pytest.raises(ConfigError, match=words):
        authority.renew(site, "base", NOW)


def test_the_key_of_another_authority_is_refused(site: Path, tmp_path: Path) -> None:
    authority.init(tmp_path / "other", NOW)
    (tmp_path / "other" / "authority" / "ca.key").replace(site / "authority" / "ca.key")
    with pytest.raises(ConfigError, match=r"not the key of ca\.pem"):
        authority.renew(site, "base", NOW)


@pytest.mark.parametrize("what", ["authority", "authority/ca.key"])
def test_an_authority_that_others_may_read_signs_nothing(site: Path, what: str) -> None:
    path = site / what
    path.chmod(path.stat().st_mode | 0o040)
    with pytest.raises(ConfigError, match=f"chmod (700|600) .*{what}"):
        authority.renew(site, "base", NOW)


# --- interruption -----------------------------------------------------------------------------------


class PowerLossError(BaseException):
    """Stands for the end of the process: what would clean up does not run either."""


def cut_at(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Has the call with this number that changes the disk fail, and all after it."""
    count = 0

    def cut(call: Callable[..., Any]) -> Callable[..., Any]:
        def instead(*arguments: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count >= number:
                raise PowerLossError
            return call(*arguments, **options)

        return instead

    for name in ("mkdir", "rename", "replace", "unlink", "rmdir", "fsync", "fchmod"):
        monkeypatch.setattr(os, name, cut(getattr(os, name)))
    monkeypatch.setattr(files, "_rename_exchange", cut(files._rename_exchange))


def test_an_interrupted_renewal_leaves_whole_credentials_and_can_be_repeated(site: Path) -> None:
    seen = set()
    for number in range(1, 60):
        folder = site / "credentials" / "base"
        before = admitted.read(site).newest("base").generation
        here = credentials.read(folder, NOW).generation
        with pytest.MonkeyPatch.context() as patch:
            cut_at(number, patch)
            try:
                authority.renew(site, "base", NOW)
                done = True
            except PowerLossError:
                done = False
        now_here, known = credentials.read(folder, NOW), admitted.read(site)
        assert now_here.generation in (here, before + 1)
        assert now_here.common_name in {each.common_name for each in known.certificate}  # nothing unknown is out
        seen.add((now_here.generation - here, known.newest("base").generation - before))
        if done:
            break
    else:
        pytest.fail("it was interrupted each time")
    assert len(seen) >= 3  # before admitted.toml, between it and the exchange, after it
    assert authority.renew(site, "base", NOW).certificate.generation == admitted.read(site).newest("base").generation
    assert [path.name for path in (site / "credentials").iterdir()] == ["base"]
    assert {path.name for path in site.iterdir()} == {"admitted.toml", "authority", "credentials"}


def test_an_interrupted_beginning_can_be_repeated(tmp_path: Path) -> None:
    for number in range(1, 60):
        site = tmp_path / str(number)
        with pytest.MonkeyPatch.context() as patch:
            cut_at(number, patch)
            try:
                authority.init(site, NOW)
                break
            except PowerLossError:
                pass
        if not (site / "authority").exists():
            authority.init(site, NOW)
        authority.issue(site, "robot", "base", NOW)
        credentials.read(site / "credentials" / "base", NOW, authority=admitted.read(site).authority)
    else:
        pytest.fail("it was interrupted each time")


@pytest.mark.parametrize("call", ["fsync", "mkdir", "replace", "fchmod"])
def test_a_full_disk_is_told_and_changes_nothing(site: Path, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = admitted.read(site)
    monkeypatch.setattr(os, call, full)
    with pytest.raises(ConfigError, match="No space left"):
        authority.renew(site, "base", NOW)
    monkeypatch.undo()
    assert admitted.read(site) == before
    assert credentials.read(site / "credentials" / "base", NOW).generation == 1
    assert [path.name for path in (site / "credentials").iterdir()] == ["base"]


def test_where_folders_cannot_be_exchanged_they_are_renamed(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def cannot(*_: Any) -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    monkeypatch.setattr(files, "_rename_exchange", cannot)
    authority.renew(site, "base", NOW)
    authority.issue(site, "operator", "ada", NOW)
    assert credentials.read(site / "credentials" / "base", NOW).generation == 2
    assert sorted(path.name for path in (site / "credentials").iterdir()) == ["ada", "base"]


def test_a_reader_beside_renewals_never_sees_files_of_two_generations(site: Path) -> None:
    done, seen, failures = threading.Event(), list[int](), list[Exception]()

    def read() -> None:
        while not done.is_set():
            try:
                seen.append(credentials.read(site / "credentials" / "base", NOW).generation)
            except Exception as error:
                failures.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(20):
        authority.renew(site, "base", NOW)
    done.set()
    reader.join()
    assert not failures
    assert seen == sorted(seen)
