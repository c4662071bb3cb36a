"""Whether this process itself was asleep: who did not run for seconds must not say that others were silent."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from cocoro.boottime import boottime_ns
from cocoro.clock import NS

BEAT_S = 0.25
"""How often a vigil looks at the time."""
LATE_S = 1.0
"""Who looks later by more was asleep or starved. Less is a busy machine, and far shorter than a lease."""
RECOVERY_S = 10.0
"""After a sleep, connections to others may break, and are made anew, for so long."""


class Vigil:
    """Keep it in the loop whose sleep matters. It counts by `boottime_ns`, which goes on while the machine sleeps."""

    def __init__(self, tell: Callable[[str], None] = lambda _: None, now_ns: Callable[[], int] = boottime_ns) -> None:
        """`tell` gets a line for people, once for each sleep."""
        self._tell = tell
        self._now_ns = now_ns
        self._seen_ns = now_ns()
        self._slept_ns = 0
        self._woke_ns: int | None = None

    async def keep(self) -> None:
        """Look for ever."""
        self._seen_ns = self._now_ns()
        while True:
            await asyncio.sleep(BEAT_S)
            self.look()

    def look(self) -> str:
        """What is to be said in place of accusing others: '' while this process is awake, and has been for a while."""
        now_ns = self._now_ns()
        late_ns = now_ns - self._seen_ns - round(BEAT_S * NS)
        self._seen_ns = now_ns
        if late_ns > LATE_S * NS:
            self._slept_ns, self._woke_ns = late_ns, now_ns
            self._tell(self._words())
        if self._woke_ns is None or now_ns - self._woke_ns > RECOVERY_S * NS:
            return ""
        return self._words()

    def _words(self) -> str:
        return f"this machine was asleep or starved for {self._slept_ns / NS:.0f} s"
