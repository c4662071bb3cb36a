"""What can truly be said of a service whose liveliness token dropped.

A token drops when its process ends, and also when the mesh has not heard of that process for the lease: because it was
stopped, because it hangs, because the way to it is broken, or because this process was itself asleep. A process of this
machine that is dead holds its claim no more (see `deploy.rundir`); of others it cannot be known.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

from cocoro.vigil import Vigil

CLAIM_S = 0.5
"""A process that dies may let go of its claim this much later than of the mesh."""
LOOK_S = 0.02


class Contact:
    """Tell it of each token that comes (`met`); it then tells what became of those that dropped.

    `claimant` gives the number of the process of this machine that is a service now: None when no process is, 0 when
    one is whose number is not known yet. It may raise OSError. Without it nothing is known of any process, and without
    a vigil this process never sleeps.
    """

    def __init__(self, claimant: Callable[[str], int | None] | None = None, vigil: Vigil | None = None) -> None:
        self._claimant = claimant
        self.vigil = vigil
        self._pids: dict[str, int] = {}
        """Of services that processes of this machine are, or were when they were met."""

    def met(self, service: str) -> None:
        """Its token is there."""
        self._pids.pop(service, None)
        with suppress(OSError):
            pid = None if self._claimant is None else self._claimant(service)
            if pid is not None:
                self._pids[service] = pid

    def dead(self, service: str) -> bool:
        """Whether it is known that the process that was this service has ended."""
        if self._claimant is None or service not in self._pids:
            return False
        try:
            pid = self._claimant(service)
        except OSError:
            return False
        return pid is None or pid not in (self._pids[service], 0)  # 0: somebody holds it, and has not said who

    async def lost(self, service: str) -> str:
        """Its token dropped: what is true of it, in words, at once or within `CLAIM_S`."""
        asleep = "" if self.vigil is None else self.vigil.look()
        if service in self._pids:
            for _ in range(round(CLAIM_S / LOOK_S)):
                if self.dead(service):
                    return f"{service} died"
                await asyncio.sleep(LOOK_S)
        return asleep or f"lost contact with {service}"
