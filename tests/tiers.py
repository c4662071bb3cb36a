"""The tiers of tests, and the check that every test is in the tier that its markers state.

Without the markers `process`, `sim` and `zenoh` a test is a unit test: it starts no process, opens no zenoh session,
and neither runs PyBullet nor draws. One that does so all the same fails, and is told which marker it lacks.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from typing import Any

import moderngl
import pytest
import zenoh

import sim.bullet  # noqa: F401  imports pybullet without its greeting

STARTS_A_PROCESS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.exec", "os.system"}
"""Audit events of the interpreter."""
CHECKED: tuple[tuple[Any, str, str], ...] = (
    (zenoh, "open", "zenoh"),
    (sys.modules["pybullet"], "connect", "sim"),
    (moderngl, "create_context", "sim"),
)
"""Module, function and the marker of tests that may call it."""


class Tiers:
    """A pytest plugin: watches each test from its fixtures' set-up to their end."""

    def __init__(self) -> None:
        self._test: pytest.Item | None = None
        self._faults: list[str] = []
        sys.addaudithook(self._audit)
        for module, name, marker in CHECKED:
            setattr(module, name, self._checked(getattr(module, name), marker, f"{module.__name__}.{name}"))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None]:
        return (yield from self._watch(item))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None]:
        return (yield from self._watch(item))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Generator[None]:
        return (yield from self._watch(item))

    def _watch(self, item: pytest.Item) -> Generator[None]:
        self._test, self._faults = item, []
        try:
            yield
        finally:
            self._test = None
        if self._faults:  # what was raised has been caught
            pytest.fail(self._faults[0], pytrace=False)

    def _audit(self, event: str, _arguments: tuple[Any, ...]) -> None:
        if event in STARTS_A_PROCESS:
            self._need("process", event)

    def _checked(self, function: Callable[..., Any], marker: str, name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            self._need(marker, name)
            return function(*arguments, **options)

        return call

    def _need(self, marker: str, did: str) -> None:
        if self._test is not None and self._test.get_closest_marker(marker) is None:
            self._faults.append(f"a test that calls {did} needs the marker `{marker}` (CONTRIBUTING.md, Tests)")
            pytest.fail(self._faults[-1])


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Tiers(), "tiers of tests")
