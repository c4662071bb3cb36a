"""What all tests share."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, settings

from cocoro.robot import Robot

# The same examples at every run, and none that fails because the machine was busy.
settings.register_profile(
    "repeatable", derandomize=True, database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The Calliope as it is described."""
    return Robot.load()
