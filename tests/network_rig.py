"""A network of hosts for tests (sim/network), which are skipped where there is none to be had."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sim.network.network import Network, obstacle


@contextmanager
def network_of(*hosts: str, mtu: int = 1500, seed: int = 0) -> Iterator[Network]:
    if why := obstacle():
        pytest.skip(why)
    with Network(*hosts, mtu=mtu, seed=seed) as network:
        yield network
