"""Reports the faults of a service: in its health, and once each in its log."""

from __future__ import annotations

from collections.abc import Iterable

from cocoro.node import Node


class FaultReporter:
    """Keeps a node's `faults` and its state, ready or degraded."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def report(self, faults: Iterable[str], *, degraded: str = "", ready: str = "") -> None:
        """Publish all faults there are now, and log those that are new.

        A fault is known by its text up to the first colon: what follows may be a measured value. `degraded` says which
        part of the service does not work ('' when all of it does), `ready` what the service says of itself then.
        """
        node = self._node
        known = {_name(fault) for fault in node.faults}
        node.faults = tuple(faults)
        for fault in node.faults:
            if _name(fault) not in known:
                node.log.warning("%s", fault)
        if degraded:
            node.degraded(degraded)
        else:
            node.ready(ready)


def _name(fault: str) -> str:
    return fault.partition(":")[0]
