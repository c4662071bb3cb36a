"""Codes and sessions of the cockpit: valid once, for a time, on this start of the machine, and never readable."""

from __future__ import annotations

from pathlib import Path

import pytest

from cocoro.errors import ConfigError, RefusedError
from services.cockpit.access_people import (
    ALPHABET,
    CODE_S,
    INVITED_MOST,
    SESSION_S,
    SESSIONS_MOST,
    People,
    named,
    role_of,
    spaced,
    typed,
)


class Rig:
    """People whose time is set by hand."""

    def __init__(self, folder: Path) -> None:
        self.now_s, self.boot, self.folder = 1000.0, "first", folder
        self.people = self.anew()

    def anew(self) -> People:
        """As another process sees them."""
        return People(self.folder, lambda: self.now_s, lambda: self.boot)


@pytest.fixture
def rig(short_path: Path) -> Rig:
    return Rig(short_path / "cockpit")


def test_a_code_lets_in_once(rig: Rig) -> None:
    code = rig.people.invite("viewer", "eve")
    begun = rig.people.log_in(code, "10.0.0.5")
    assert begun is not None
    token, session = begun
    assert (session.name, session.role, session.address) == ("eve", "viewer", "10.0.0.5")
    assert rig.people.log_in(code, "10.0.0.5") is None
    assert rig.anew().log_in(code, "10.0.0.6") is None
    found = rig.anew().session(token)
    assert found is not None
    assert found[1] == session


def test_a_code_is_taken_by_one_of_many_that_give_it_at_the_same_time(rig: Rig) -> None:
    from concurrent.futures import ThreadPoolExecutor

    code = rig.people.invite("operator")
    with ThreadPoolExecutor(8) as pool:
        found = [*pool.map(lambda _: rig.people.log_in(code, "10.0.0.5"), range(64))]
    assert len([one for one in found if one is not None]) == 1


def test_a_code_is_read_as_a_person_types_it(rig: Rig) -> None:
    code = rig.people.invite("viewer")
    assert set(code) <= set(ALPHABET)
    written = f"  {spaced(code).lower().replace('0', 'o').replace('1', 'l')} "
    assert typed(written) == code
    assert rig.people.log_in(written, "here") is not None


def test_a_code_and_a_session_end_with_their_time(rig: Rig) -> None:
    code = rig.people.invite("viewer")
    rig.now_s += CODE_S
    assert rig.people.log_in(code, "here") is None
    begun = rig.people.log_in(rig.people.invite("viewer"), "here")
    assert begun is not None
    rig.now_s += SESSION_S - 1.0
    assert rig.people.session(begun[0]) is not None
    rig.now_s += 1.0
    assert rig.people.session(begun[0]) is None
    assert rig.people.listed() == []


def test_nothing_of_another_start_of_the_machine_is_valid(rig: Rig) -> None:
    code, begun = rig.people.invite("viewer"), rig.people.log_in(rig.people.invite("operator"), "here")
    assert begun is not None
    rig.boot, rig.now_s = "second", 5.0
    later = rig.anew()
    assert later.log_in(code, "here") is None
    assert later.session(begun[0]) is None


def test_a_time_that_is_too_far_ahead_is_not_believed(rig: Rig) -> None:
    begun = rig.people.log_in(rig.people.invite("operator"), "here")
    assert begun is not None
    rig.now_s -= 3600.0
    assert rig.people.session(begun[0]) is None


def test_the_folder_tells_no_code_and_no_token_and_is_this_users_alone(rig: Rig) -> None:
    code = rig.people.invite("viewer")
    begun = rig.people.log_in(rig.people.invite("operator"), "here")
    assert begun is not None
    files = [path for path in rig.folder.rglob("*") if path.is_file()]
    assert len(files) == 2
    for path in files:
        said = path.read_text() + str(path)
        assert code not in said
        assert begun[0] not in said
        assert path.stat().st_mode & 0o077 == 0
    assert all(path.stat().st_mode & 0o022 == 0 for path in rig.folder.rglob("*"))


@pytest.mark.parametrize(
    "given", ["", "x", "0" * 12, "../../etc/passwd", "\0", "A" * 10_000, "é" * 12, "\udcff", "' or 1=1", "invited/x"]
)
def test_what_is_no_code_and_no_token_lets_in_nobody(rig: Rig, given: str) -> None:
    rig.people.invite("operator")
    assert rig.people.log_in(given, "here") is None
    assert rig.people.session(given) is None


@pytest.mark.parametrize("said", [b"", b"{}", b"[]", b'{"role":"king"}', b"\xff", b"null", b"[" * 5000])
def test_a_damaged_file_lets_in_nobody_and_is_removed(rig: Rig, said: bytes) -> None:
    begun = rig.people.log_in(rig.people.invite("operator"), "here")
    assert begun is not None
    (path,) = (rig.folder / "sessions").iterdir()
    path.write_bytes(said)
    assert rig.people.session(begun[0]) is None
    assert rig.people.listed() == []
    assert not path.exists()


def test_who_is_ended_is_no_longer_let_in(rig: Rig) -> None:
    tokens = {}
    for name in ("eve", "ada"):
        begun = rig.people.log_in(rig.people.invite("viewer", name), "here")
        assert begun is not None
        tokens[name] = begun[0]
    code = rig.people.invite("viewer", "eve")
    assert [row.kind for row in rig.people.end("eve")] == ["invited", "session"]
    assert rig.people.session(tokens["eve"]) is None
    assert rig.people.log_in(code, "here") is None
    assert rig.people.session(tokens["ada"]) is not None
    with pytest.raises(ConfigError, match="ada"):
        rig.people.end("eve")
    (row,) = rig.people.end(rig.people.listed()[0].key)
    assert row.name == "ada"
    assert rig.people.end("all") == []


def test_codes_and_sessions_are_few(rig: Rig) -> None:
    codes = [rig.people.invite("viewer") for _ in range(INVITED_MOST)]
    with pytest.raises(RefusedError, match="cocoro cockpit end all"):
        rig.people.invite("viewer")
    for _ in range(SESSIONS_MOST // INVITED_MOST):
        for code in codes:
            assert rig.people.log_in(code, "here") is not None
        codes = [rig.people.invite("viewer") for _ in range(INVITED_MOST)]
    with pytest.raises(RefusedError, match="cocoro cockpit list"):
        rig.people.log_in(codes[0], "here")
    rig.people.end(rig.people.listed()[-1].key)
    assert rig.people.log_in(codes[0], "here") is not None


def test_a_session_ends_when_its_visitor_logs_out(rig: Rig) -> None:
    begun = rig.people.log_in(rig.people.invite("viewer"), "here")
    assert begun is not None
    assert rig.people.log_out(begun[0])
    assert not rig.people.log_out(begun[0])
    assert rig.people.session(begun[0]) is None


def test_a_folder_of_another_user_is_refused(rig: Rig) -> None:
    rig.folder.mkdir()
    (rig.folder / "invited").mkdir(mode=0o777)
    (rig.folder / "invited").chmod(0o777)
    with pytest.raises(ConfigError, match="invited"):
        rig.people.invite("viewer")


def test_roles_and_names_that_are_none_are_named() -> None:
    with pytest.raises(ConfigError, match=r"admin.*viewer, operator"):
        role_of("admin")
    for wrong in ("", "a b", "a\n", "x" * 40, "<b>"):
        with pytest.raises(ConfigError, match="--name"):
            named(wrong)
