"""admitted.toml: which common names are admitted at a time, and how a damaged file is refused."""

from __future__ import annotations

from contextlib import suppress
from datetime import timedelta
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from site_rig import DAY, NOW

from cocoro.errors import ConfigError
from deploy.site import admitted, files
from deploy.site.admitted import Admitted, Certificate
from deploy.site.roles import ROLES

PATH = Path("lab/admitted.toml")
AUTHORITY = "ab" * 32


def certificate(name: str = "base", generation: int = 1, **fields: object) -> Certificate:
    defaults = {"role": "robot", "serial": f"{name.encode().hex()}{generation:04x}", "not_before": NOW}
    return msgspec.convert(
        defaults | {"name": name, "generation": generation, "expires": NOW + 90 * DAY} | fields, Certificate
    )


def site(*certificates: Certificate) -> Admitted:
    return Admitted(authority=AUTHORITY, certificate=certificates)


def test_a_name_is_admitted_with_its_valid_generations_and_the_next() -> None:
    both = site(certificate(), certificate("ada", role="operator"), certificate(generation=2, expires=NOW + 150 * DAY))
    assert both.valid(NOW) == ("base.1", "base.2", "base.3", "ada.1", "ada.2")
    assert both.common_names("base", NOW) == ("base.1", "base.2", "base.3")
    assert both.newest("base").generation == 2


def test_an_expired_generation_is_not_admitted_but_the_next_one_still_is() -> None:
    both = site(certificate(), certificate(generation=2, expires=NOW + 150 * DAY))
    last = NOW + 90 * DAY - timedelta(seconds=1)
    assert both.valid(last) == ("base.1", "base.2", "base.3")
    assert both.valid(NOW + 90 * DAY) == ("base.2", "base.3")
    assert both.valid(NOW + 150 * DAY) == ("base.3",)


def test_a_revoked_name_is_not_admitted_until_it_is_issued_anew() -> None:
    revoked = (certificate(revoked=True), certificate(generation=2, revoked=True))
    assert site(*revoked).valid(NOW) == ()
    assert site(*revoked, certificate(generation=3)).valid(NOW) == ("base.3", "base.4")


def test_days_are_counted_down_to_the_last() -> None:
    each = certificate()
    assert [each.days_left(NOW + days * DAY) for days in (0, 89.5, 90, 90.5)] == [90, 0, 0, -1]
    assert each.is_valid(NOW + 89.9 * DAY)
    assert not each.is_valid(NOW + 90 * DAY)


def test_an_unknown_name_is_answered_by_those_that_are_known() -> None:
    with pytest.raises(ConfigError, match="did you mean base"):
        site(certificate()).newest("bsae")


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    wanted = site(certificate(addresses=["10.77.0.1", "fe80::1", "base.local"]), certificate("ada", revoked=True))
    with files.locked(tmp_path) as fd:
        admitted.write(tmp_path, fd, wanted)
    assert admitted.read(tmp_path) == wanted
    assert (tmp_path / "admitted.toml").stat().st_mode & 0o777 == 0o644
    assert [path.name for path in tmp_path.iterdir()] == ["admitted.toml"]


GOOD = admitted.text_of(site(certificate(), certificate("ada")))


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('role = "robot"', 'role = "robto"', ["[[certificate]] 1", "role", "robto", "did you mean robot"]),
        ('name = "base"', 'name = "../base"', ["[[certificate]] 1", "name", "small letters"]),
        ('name = "base"', 'name = "a\\nb"', ["[[certificate]] 1", "name", "small letters"]),
        ("generation = 1", "generation = 0", ["[[certificate]] 1", "generation"]),
        ('name = "ada"', 'name = "base"', ["[[certificate]] 2", "generation", "ascend"]),
        ("expires = 2031-07-30T12:00:00Z", "expires = 2031-07-30T12:00:00", ["[[certificate]] 1", "expires"]),
        ("expires = 2031-07-30T12:00:00Z", "expires = 2031-04-30T12:00:00Z", ["[[certificate]] 1", "expires"]),
        ("expires = 2031-07-30T12:00:00Z", "expires = 9999-07-30T12:00:00Z", ["[[certificate]] 1", "expires"]),
        ("expires = 2031-07-30T12:00:00Z", 'expires = "soon"', ["[[certificate]] 1", "expires"]),
        ("revoked = false", "revoked = 0", ["[[certificate]] 1", "revoked"]),
        ("revoked = false", "revokd = true", ["[[certificate]] 1", "unknown field 'revokd'", "did you mean revoked"]),
        (f'authority = "{AUTHORITY}"', 'authority = "ABC"', ["authority"]),
        ("[[certificate]]", "[certificate]", ["certificate"]),
        ("[[certificate]]", "[[certificates]]", ["unknown field 'certificates'", "certificate"]),
        ("addresses = []", 'addresses = ["a b"]', ["[[certificate]] 1", "addresses"]),
        ("revoked = false", "revoked = fals", ["line"]),
        (GOOD, "a = " + "[" * 5000, ["lab/admitted.toml"]),
    ],
)
def test_a_wrong_file_is_refused_by_table_and_field(before: str, after: str, words: list[str]) -> None:
    assert before in GOOD
    count = -1 if "certificate]" in before else 1
    with pytest.raises(ConfigError) as caught:
        admitted.parse(GOOD.replace(before, after, count).encode(), PATH)
    for word in (str(PATH), *words):
        assert word in str(caught.value)


def test_one_serial_is_not_that_of_two() -> None:
    twice = site(certificate(serial="a1"), certificate("ada", serial="a1"))
    with pytest.raises(ConfigError, match=r"\[\[certificate\]\] 2: serial"):
        admitted.parse(admitted.text_of(twice).encode(), PATH)


@given(st.data())
def test_a_damaged_file_is_read_or_refused_in_words(data: st.DataObject) -> None:
    damaged = bytearray(GOOD.encode())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        damaged[at : at + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=3))
    with suppress(ConfigError):  # any other exception fails
        admitted.parse(bytes(damaged), PATH).valid(NOW)


def test_a_missing_file_or_site_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"admitted\.toml is missing: copy it"):
        admitted.read(tmp_path)
    with pytest.raises(ConfigError, match="there is no such folder"):
        admitted.read(tmp_path / "none")


def test_a_file_that_others_may_change_is_not_believed(tmp_path: Path) -> None:
    (tmp_path / "admitted.toml").write_text(GOOD)
    (tmp_path / "admitted.toml").chmod(0o666)
    with pytest.raises(ConfigError, match=r"chmod 644 .*admitted\.toml"):
        admitted.read(tmp_path)


@pytest.mark.parametrize(
    "name", ["", "../x", "-x", "x\n", "x\ny", "X", ".x", "a" * 33, "a/b", "ä", "a b", "a.1", "$(id)"]
)
def test_a_hostile_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="small letters"):
        admitted.named(name)


def test_a_role_that_is_none_is_answered_by_those_that_are() -> None:
    assert [admitted.role_of(role) for role in ROLES] == ["robot", "brain", "hub", "operator", "viewer", "author"]
    with pytest.raises(ConfigError, match="did you mean viewer"):
        admitted.role_of("viewr")
