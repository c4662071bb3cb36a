"""Another user of the machine plants links and directories where the run directory is to be: nothing follows them."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from cocoro import held_file, private
from cocoro.bus.register import Membership, members
from cocoro.errors import CocoroError, ConfigError
from cocoro.held_file import Holder, holder_of
from deploy.rundir import RunDir, robots
from sim.wire.line import PseudoSerialPort

NOBODY = 65534
NO_PROCESS = 2**31 - 1
"""Above every process number that Linux gives."""
BEFORE = b"what the victim wrote"

root_alone = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user for a moment")


@contextmanager
def as_nobody() -> Iterator[None]:
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def shared() -> Iterator[Path]:
    """A place as /tmp is."""
    place = Path(tempfile.mkdtemp(prefix="cocoro"))
    place.chmod(0o1777)
    yield place
    shutil.rmtree(place)


@pytest.fixture
def victim(shared: Path) -> Path:
    """A folder of ours with a file in it that must not be touched."""
    home = shared / "home"
    home.mkdir(mode=0o755)
    (home / "file").write_bytes(BEFORE)
    return home


def untouched(victim: Path) -> bool:
    return [path.name for path in victim.iterdir()] == ["file"] and (victim / "file").read_bytes() == BEFORE


def make(run_dir: RunDir) -> None:
    run_dir.make()


def hold(run_dir: RunDir) -> None:
    run_dir.hold_supervisor("sim").release()


def claim(run_dir: RunDir) -> None:
    run_dir.claim("executive", ["executive"])[0].release()


def remember(run_dir: RunDir) -> None:
    run_dir.remember(b"{}")


def log(run_dir: RunDir) -> None:
    run_dir.new_log("supervisor").close()


def errors(run_dir: RunDir) -> None:
    os.close(private.open_file(run_dir.logs / "supervisor.err", os.O_CREAT | os.O_WRONLY | os.O_TRUNC, make=True))


def register(run_dir: RunDir) -> None:
    Membership.register(run_dir.path, "executive").leave()


def plug(run_dir: RunDir) -> None:
    PseudoSerialPort(run_dir.path / "wire" / "create").close()


WRITES: dict[str, tuple[Callable[[RunDir], None], tuple[str, ...]]] = {
    "make": (make, ()),
    "supervisor": (hold, ("supervisor",)),
    "claims": (claim, ("claims/executive",)),
    "profile": (remember, (".profile.json.{pid}",)),
    "logs": (log, ("logs/supervisor.log",)),
    "errors": (errors, ("logs/supervisor.err",)),
    "register": (register, ("lock",)),
    "wire": (plug, ("wire",)),
}
"""Functions that write below the run directory, with the files that they write; {pid} is this process's number."""
LOOKS: tuple[Callable[[RunDir], object], ...] = (
    RunDir.supervisor,
    RunDir.claims,
    RunDir.resolved,
    lambda run_dir: members(run_dir.path),
    lambda run_dir: robots(run_dir.root),
)
"""Functions that only read; their callers signal the processes and join the mesh that they find."""


def here(files: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name.format(pid=os.getpid()) for name in files)


writes = pytest.mark.parametrize(("write", "files"), WRITES.values(), ids=WRITES)


@root_alone
@writes
def test_links_in_another_user_s_directory_are_not_followed(
    shared: Path, victim: Path, write: Callable[[RunDir], None], files: tuple[str, ...]
) -> None:
    victim.chmod(0o777)  # he might even reach it himself
    with as_nobody():
        for name in here(files) or ("supervisor",):
            planted = shared / "cocoro" / "robbie" / name
            planted.parent.mkdir(parents=True)
            planted.symlink_to(victim / "file")
    with pytest.raises(ConfigError, match="it belongs to nobody: operate that user's robots as that user"):
        write(RunDir("robbie", shared / "cocoro"))
    assert untouched(victim)


@root_alone
@writes
@pytest.mark.parametrize("target", ["home", "home/file", "home/new"], ids=["directory", "file", "dangling"])
@pytest.mark.parametrize("place", ["cocoro", "cocoro/robbie"])
def test_a_link_in_a_directory_s_place_is_not_followed(
    shared: Path, victim: Path, write: Callable[[RunDir], None], files: tuple[str, ...], place: str, target: str
) -> None:
    if "/" in place:  # he may write into a run directory that lets him
        (shared / "cocoro").mkdir()
        (shared / "cocoro").chmod(0o1777)
    with as_nobody():
        (shared / place).symlink_to(shared / target)
    with pytest.raises(ConfigError, match="it is a link, which is not followed here"):
        write(RunDir("robbie", shared / "cocoro"))
    assert untouched(victim)


@writes
@pytest.mark.parametrize("target", ["file", "new"], ids=["file", "dangling"])
def test_a_link_in_a_file_s_place_is_not_followed(
    shared: Path, victim: Path, write: Callable[[RunDir], None], files: tuple[str, ...], target: str
) -> None:
    """Even where nobody else can have put it; an old log is set aside, link or not."""
    run_dir = RunDir("robbie", shared / "cocoro")
    for name in here(files):
        planted = run_dir.path / name
        planted.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        planted.symlink_to(victim / target)
    if files and write is not log:
        with pytest.raises(ConfigError, match=r"it is a link"):
            write(run_dir)
    else:
        write(run_dir)
    assert untouched(victim)


@root_alone
@pytest.mark.parametrize("look", LOOKS)
def test_root_takes_nothing_from_another_user_s_directory(shared: Path, look: Callable[[RunDir], object]) -> None:
    run_dir = RunDir("robbie", shared / "cocoro")
    with as_nobody():
        run_dir.make()
        run_dir.remember(b'{"mesh": {"connect": ["tcp/127.0.0.1:7447"]}}')
        held = run_dir.hold_supervisor("sim")
        claims = run_dir.claim("sim", ["base"])
        membership = Membership.register(run_dir.path, "sim")
        assert run_dir.populated
    try:
        with pytest.raises(ConfigError, match="it belongs to nobody"):
            look(run_dir)
        with pytest.raises(ConfigError, match="it belongs to nobody"):
            register(run_dir)
    finally:
        membership.leave()
        held.release()
        claims[0].release()


@root_alone
def test_another_user_s_folder_among_ours_is_no_robot_of_ours(shared: Path) -> None:
    with as_nobody():
        RunDir("his", shared).make()
    ours = RunDir("ours", shared)
    held = ours.hold_supervisor("sim")
    assert [run_dir.robot for run_dir in robots(shared)] == ["ours"]
    held.release()


@root_alone
def test_another_user_s_file_among_ours_is_refused(shared: Path) -> None:
    run_dir = RunDir("robbie", shared)
    run_dir.make()
    file = run_dir.path / "supervisor"
    file.write_bytes(BEFORE)
    os.chown(file, NOBODY, NOBODY)
    with pytest.raises(ConfigError, match="it belongs to nobody"):
        run_dir.hold_supervisor("sim")
    with pytest.raises(ConfigError, match="it belongs to nobody"):
        run_dir.supervisor()
    assert file.read_bytes() == BEFORE


def test_a_link_of_one_s_own_leads_where_nobody_else_could_have_put_it(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to("disk")
    RunDir("robbie", tmp_path / "run" / "cocoro").make()
    assert (tmp_path / "disk" / "cocoro" / "robbie" / "logs").is_dir()


def test_links_that_lead_in_a_circle_end(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(ConfigError, match="it is a link"):
        RunDir("robbie", tmp_path / "a").make()


@pytest.mark.parametrize("kind", ["fifo", "directory"])
def test_what_is_no_regular_file_is_refused_and_waits_for_nobody(tmp_path: Path, kind: str) -> None:
    run_dir = RunDir("robbie", tmp_path)
    run_dir.make()
    file = run_dir.path / "supervisor"
    os.mkfifo(file) if kind == "fifo" else file.mkdir()
    with pytest.raises(ConfigError, match="it is not a regular file"):
        run_dir.supervisor()
    with pytest.raises(ConfigError, match=r"it is not a regular file|Is a directory"):
        run_dir.hold_supervisor("sim")


def test_what_is_made_is_for_this_user_alone(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without COCORO_RUN_DIR and XDG_RUNTIME_DIR the folders lie below the place for temporary files."""
    for variable in ("COCORO_RUN_DIR", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(private, "TEMPORARY", str(shared))
    run_dir = RunDir("robbie")
    assert run_dir.root == shared / f"cocoro-{os.getuid()}"
    for write, _ in WRITES.values():
        write(run_dir)
    made = [shared / f"cocoro-{os.getuid()}", *(shared / f"cocoro-{os.getuid()}").rglob("*")]
    assert {"supervisor", "claims", "executive", "profile.json", "logs", "supervisor.log", "wire"} <= {
        path.name for path in made
    }
    for path in made:
        assert stat.S_IMODE(path.lstat().st_mode) & 0o022 == 0, path
        assert not path.is_dir() or stat.S_IMODE(path.stat().st_mode) == 0o700, path


def test_a_file_that_cannot_be_written_whole_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = RunDir("robbie", tmp_path)
    run_dir.remember(b'{"name": "sim"}')

    def replace(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(private.FullError, match=r"profile.json: No space left on device; make room there"):
        run_dir.remember(b'{"name": "robot"}')
    assert run_dir.resolved() == {"name": "sim"}
    assert [path.name for path in run_dir.path.iterdir()] == ["profile.json"]


def test_a_held_file_that_says_nothing_is_held_by_somebody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cocoro.held_file.LOOK_S", 0.01)
    run_dir = RunDir("robbie", tmp_path)
    held = run_dir.claim("executive", ["executive"])
    for rubbish in (b"", b"\xff\x00", b"[" * 4096, b'{"name": 1}', b'{"name": "x", "pid": -7}', b'{"pid": 1e99}'):
        (run_dir.path / "claims" / "executive").write_bytes(rubbish)
        assert run_dir.claims() == {}
        with pytest.raises(CocoroError, match="robbie has an executive already"):
            run_dir.claim("other", ["executive"])
    held[0].release()


@pytest.mark.parametrize("end", ["its death", "letting go"])
def test_a_new_holder_is_not_taken_for_the_last_one_before_it_has_written_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str
) -> None:
    """A process that looks in that moment waits for the name."""
    path, own = tmp_path / "executive", Holder("executive", os.getpid())
    if end == "its death":
        path.write_bytes(msgspec.json.encode(Holder("executive", NO_PROCESS)._asdict()))
    else:
        held = held_file.hold(path, "executive")
        assert held is not None
        held.release()
    with path.open("rb") as new, path.open("rb") as reader:
        fcntl.flock(new, fcntl.LOCK_EX)
        monkeypatch.setattr("time.sleep", lambda _: path.write_bytes(msgspec.json.encode(own._asdict())))
        assert holder_of(reader.fileno(), patience_s=60.0) == own
