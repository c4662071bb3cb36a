"""Virtual time: tests that are coroutines, and a clock that jumps."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any, ParamSpec

from cocoro.clock import NS, VirtualClock
from cocoro.vloop import VirtualTimeLoop, run_virtual

P = ParamSpec("P")

LIMIT_S = 3600.0
"""Virtual time after which a test counts as stuck, s."""
_SETTLE_TURNS = 64
"""At most, lest a task that never waits for anything holds it for ever."""


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """Decorator of a test that is a coroutine. Its sleeps and time-outs take no real time; fixtures work as usual."""

    @wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        run_virtual(asyncio.wait_for(test(*args, **kwargs), LIMIT_S))

    return run


async def settle() -> None:
    """Run everything that is due now; no time passes. Without virtual time it gives others some turns."""
    loop = asyncio.get_running_loop()
    for _ in range(_SETTLE_TURNS):
        await asyncio.sleep(0)
        if isinstance(loop, VirtualTimeLoop) and not loop.due:
            return


class JumpingClock(VirtualClock):
    """Follows the loop's virtual time, and can jump: back, as the clock of a restarted simulator, or ahead."""

    of_loop = False

    def __init__(self) -> None:
        self.epoch = 0
        self._offset_ns = 0
        self._jumped = asyncio.Event()

    def now_ns(self) -> int:
        return super().now_ns() + self._offset_ns

    def jump_to(self, now_s: float) -> None:
        """Set the clock, s. A jump back begins a new epoch; a jump ahead does not."""
        now_ns = round(now_s * NS)
        if now_ns < self.now_ns():
            self.epoch += 1
        self._offset_ns += now_ns - self.now_ns()
        jumped, self._jumped = self._jumped, asyncio.Event()
        jumped.set()

    async def sleep_until(self, when_ns: int) -> bool:
        epoch = self.epoch
        await asyncio.sleep(0)
        while (left_ns := when_ns - self.now_ns()) > 0 and self.epoch == epoch:
            try:
                async with asyncio.timeout(left_ns / NS):
                    await self._jumped.wait()
            except TimeoutError:
                # The loop's time is a float: it may be a nanosecond short.
                self._offset_ns += max(when_ns - self.now_ns(), 0)
        return self.epoch == epoch
