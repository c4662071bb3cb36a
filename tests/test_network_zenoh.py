"""Zenoh sessions on two hosts of an emulated network."""

from __future__ import annotations

import pytest
from network_rig import network_of

from bench.network_speaker import PERIOD_S, Speaker

pytestmark = [pytest.mark.zenoh, pytest.mark.process]

CUT_S = 3.0


@pytest.mark.parametrize("lease_s", [4.0, 1.0], ids=["within the lease", "beyond the lease"])
def test_a_client_over_a_slow_link_hears_its_router_again_after_a_cut(lease_s: float) -> None:
    with network_of("base", "brain") as network:
        network.link("base", "brain").set(delay_ms=20)
        base, brain = network.host("base"), network.host("brain")
        endpoint = f"tcp/{base.address}:7447"
        Speaker(base, "router", endpoint, lease_s)
        client = Speaker(brain, "client", endpoint, lease_s)
        assert client.ask("first") == "first"
        before = client.tick_from(0)
        network.cut("base", for_s=CUT_S)
        # The router counts no faster than its period, so it put this message after the cut.
        client.tick_from(before + round(2 * CUT_S / PERIOD_S))
        assert network.links().counts().cut > 0
        assert client.ask("second") == "second"
