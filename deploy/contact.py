"""Finds out what became of a service whose liveliness token dropped, and whether this process itself was asleep.

A token drops when its process ends, and also when the mesh has not heard from that process for the lease: because it
was stopped, it hangs, gets no processor time, the connection is broken, or this process was asleep. A dead process of
this machine no longer holds its claim (see `deploy.rundir`); where its claim cannot be read, /proc no longer has its
number with its start time. About processes of other machines nothing more is known.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import NamedTuple

from cocoro.clock import NS, steady_ns
from cocoro.contact import Contact
from deploy.processor import start_of

CLAIM_S = 0.5
"""A dying process may lose its claim this much later than its liveliness token."""
LOOK_S = 0.02
BEAT_S = 0.25
"""Period of `SleepDetector`'s checks."""
LATE_S = 1.0
"""A check that is later than this means that the process was asleep or starved. Less is a busy machine, and far shorter
than a lease."""
RECOVERY_S = 10.0
"""After a sleep, connections to others may break and are renewed for this long."""


class SleepDetector:
    """Detects that this process did not run for seconds; it must then not report that others were silent.

    Run `keep` in the event loop that matters. It counts by `steady_ns`, which goes on while the machine is suspended.
    """

    def __init__(self, report: Callable[[str], None] = lambda _: None, now_ns: Callable[[], int] = steady_ns) -> None:
        """`report` is called with one line for people, once for each sleep."""
        self._report = report
        self._now_ns = now_ns
        self._seen_ns = now_ns()
        self._slept_ns = 0
        self._woke_ns: int | None = None

    async def keep(self) -> None:
        """Checks for ever."""
        self._seen_ns = self._now_ns()
        while True:
            await asyncio.sleep(BEAT_S)
            self.look()

    def look(self) -> str:
        """Checks now. Returns the sentence to report instead of others' silence; '' when this process has been awake
        for `RECOVERY_S`."""
        now_ns = self._now_ns()
        late_ns = now_ns - self._seen_ns - round(BEAT_S * NS)
        self._seen_ns = now_ns
        if late_ns > LATE_S * NS:
            self._slept_ns, self._woke_ns = late_ns, now_ns
            self._report(self._sentence())
        if self._woke_ns is None or now_ns - self._woke_ns > RECOVERY_S * NS:
            return ""
        return self._sentence()

    def _sentence(self) -> str:
        return f"this machine was asleep or starved for {self._slept_ns / NS:.0f} s"


class _Met(NamedTuple):
    """The process that was a service when it was met."""

    pid: int
    """0 while its number is not known."""
    start: int | None
    """Its start time as /proc has it; None where it cannot be read."""


class ProcessContact(Contact):
    """Knows the processes behind the services of this machine. Call `met` for each token that appears.

    `claimant` returns the number of the process of this machine that is a service now: None when there is none, 0 when
    its number is not known yet; it may raise OSError. Without it, nothing is known of any process. Without a
    `SleepDetector`, this process is taken to be always awake.
    """

    def __init__(
        self, claimant: Callable[[str], int | None] | None = None, sleep_detector: SleepDetector | None = None
    ) -> None:
        self._claimant = claimant
        self._sleep_detector = sleep_detector
        self.keeps = sleep_detector is not None
        self._met: dict[str, _Met] = {}

    async def keep(self) -> None:
        if self._sleep_detector is not None:
            await self._sleep_detector.keep()

    def met(self, service: str) -> None:
        self._met.pop(service, None)
        try:
            pid = None if self._claimant is None else self._claimant(service)
        except OSError:
            return
        if pid is not None:
            self._met[service] = _Met(pid, start_of(pid))

    def dead(self, service: str) -> bool:
        if self._claimant is None or service not in self._met:
            return False
        met = self._met[service]
        try:
            pid = self._claimant(service)
        except OSError:  # its claim cannot be read
            return met.start is not None and start_of(met.pid) != met.start
        if met.pid == 0 and pid:  # now its number is known
            self._met[service] = _Met(pid, start_of(pid))
            return False
        return pid is None or pid not in (met.pid, 0)  # 0: the claim is held, by a number not known yet

    def lives(self, service: str) -> bool:
        return service in self._met and not self.dead(service)

    def starting(self, service: str) -> bool:
        if self._claimant is None or not self.dead(service):
            return False
        try:
            return bool(self._claimant(service))
        except OSError:
            return False

    async def lost(self, service: str) -> str:
        """The reason for which the contact was lost, as the base class says it; returns within `CLAIM_S`."""
        asleep = "" if self._sleep_detector is None else self._sleep_detector.look()
        if service in self._met:
            for _ in range(round(CLAIM_S / LOOK_S)):
                if self.dead(service):
                    return f"{service} died"
                await asyncio.sleep(LOOK_S)
        return asleep or f"lost contact with {service}"
