"""The faults of a service, as its health and its log show them."""

from __future__ import annotations

import pytest
from node_rig import Mesh

from cocoro.faults import FaultReporter
from cocoro.vloop import run_virtual


def test_a_fault_is_logged_when_it_appears_but_not_when_its_value_changes(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def scenario() -> None:
        async with Mesh().node("base") as node:
            reporter = FaultReporter(node)

            def shown() -> tuple[tuple[str, ...], str, str]:
                return node.faults, node.state, node.text

            reporter.report(["the battery is low: 14%"], degraded="no Create")
            assert shown() == (("the battery is low: 14%",), "degraded", "no Create")
            reporter.report(["the battery is low: 13%", "a wheel hangs in the air"])
            assert shown() == (("the battery is low: 13%", "a wheel hangs in the air"), "ready", "")
            reporter.report([], ready="works")
            assert shown() == ((), "ready", "works")
            reporter.report(["the battery is low: 12%"])

    run_virtual(scenario())
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["the battery is low: 14%", "a wheel hangs in the air", "the battery is low: 12%"]
