"""Fixtures and settings for all tests. The tiers and their markers are in `tiers.py`."""

from __future__ import annotations

import itertools
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

# As the robot's own processes have it, and before numpy is imported: two workers with two threads each spin in vain.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import msgspec
import pytest
from bus_rig import Local, Mesh, Zenoh
from hypothesis import HealthCheck, settings
from pictures import renderer_of
from places import in_short_folder

from cocoro import publisher
from cocoro.bus import shared
from cocoro.robot import Robot
from sim.render import Renderer

pytest_plugins = ["clock_rig", "page_rig", "run_record", "run_spread", "tiers"]

# Every run draws the same examples, and no example fails because the machine is busy.
settings.register_profile(
    "repeatable", derandomize=True, database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")

# A shell starts background jobs with SIGINT ignored, and the processes of tests would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The Calliope by its description file, not calibrated."""
    return Robot.load()


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder for sockets."""
    with in_short_folder() as folder:
        yield folder


@pytest.fixture
def root(short_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the run directories, for this process and those that it starts."""
    monkeypatch.setenv("COCORO_RUN_DIR", str(short_path))
    return short_path


@pytest.fixture
def directory(short_path: Path) -> Path:
    """The directory of one robot's mesh, before its first process makes it."""
    return short_path / "robot"


@pytest.fixture(params=["local", pytest.param("zenoh", marks=pytest.mark.zenoh)])
def mesh(request: pytest.FixtureRequest, short_path: Path) -> Mesh:
    """Each of the two buses in turn."""
    return Local() if request.param == "local" else Zenoh(short_path)


@pytest.fixture(scope="session")
def states(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folders for latch records, not made yet: cheaper than `mktemp`, which looks through all earlier ones."""
    folder = tmp_path_factory.mktemp("states")
    return (folder / str(number) for number in itertools.count())


@pytest.fixture(autouse=True)
def latches_of_this_test(states: Iterator[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test its own folder for latch records, so that it begins with none latched."""
    state = next(states)
    state.mkdir(mode=0o700)
    monkeypatch.setenv("COCORO_STATE_DIR", str(state))


@pytest.fixture(autouse=True)
def log_of_this_test() -> Iterator[None]:
    """Remove what a command has added to the log: it writes to the standard error of this test, which ends with it."""
    yield
    root = logging.getLogger()
    for handler in [handler for handler in root.handlers if type(handler) is logging.StreamHandler]:
        root.removeHandler(handler)


@pytest.fixture(scope="session", autouse=True)
def captures_of_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Have robots of tests record into pytest's temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COCORO_CAPTURE_DIR", str(tmp_path_factory.mktemp("captures")))
        yield


@pytest.fixture(scope="session", autouse=True)
def numbers_of_messages() -> Iterator[None]:
    """Refuse NumPy scalars in messages, so that tests find a core that makes them; a robot converts and sends them."""

    def refuse(value: object) -> object:
        raise TypeError(f"a {type(value).__name__} is in a message: convert it where it is made")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publisher, "_ENCODER", msgspec.msgpack.Encoder(enc_hook=refuse))
        yield


@pytest.fixture(params=["moderngl", "tiny"])
def renderer(request: pytest.FixtureRequest) -> Renderer:
    return renderer_of(request.param)


@pytest.fixture
def gl() -> Renderer:
    return renderer_of("moderngl")


@pytest.fixture
def needs_pool() -> None:
    if why := shared.obstacle(2 * (shared.POOL_BYTES + shared.PROCESS_BYTES)):
        pytest.skip(why)
