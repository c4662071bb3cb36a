"""What all tests share."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_rig import Local, Mesh, Zenoh
from hypothesis import HealthCheck, settings
from pictures import renderer_of

from cocoro.bus import shared
from cocoro.robot import Robot
from sim.render import Renderer

pytest_plugins = ["clock_rig"]

# The same examples at every run, and none that fails because the machine was busy.
settings.register_profile(
    "repeatable", derandomize=True, database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")

# A shell's background job ignores Ctrl-C, and so would all that is started from here.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The Calliope as it is described."""
    return Robot.load()


@pytest.fixture
def short_path() -> Iterator[Path]:
    """Sockets live there."""
    with tempfile.TemporaryDirectory(prefix="cocoro") as folder:
        yield Path(folder)


@pytest.fixture
def root(short_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run directories' place, for this process and those that it starts."""
    monkeypatch.setenv("COCORO_RUN_DIR", str(short_path))
    return short_path


@pytest.fixture
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the processes of one robot's mesh will meet: sockets will live there."""
    return tmp_path_factory.mktemp("m") / "robot"


@pytest.fixture(params=["local", pytest.param("zenoh", marks=pytest.mark.zenoh)])
def mesh(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    """Either bus."""
    return Local() if request.param == "local" else Zenoh(tmp_path_factory.mktemp("m"))


@pytest.fixture(autouse=True)
def latches_of_this_test(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test begins on a machine that never knew an emergency stop."""
    monkeypatch.setenv("COCORO_STATE_DIR", str(tmp_path_factory.mktemp("state")))


@pytest.fixture(scope="session", autouse=True)
def captures_of_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What robots of tests record goes with the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COCORO_CAPTURE_DIR", str(tmp_path_factory.mktemp("captures")))
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
