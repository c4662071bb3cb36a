"""A clock that can be made to misbehave, in virtual time."""

from __future__ import annotations

import asyncio

from cocoro.clock import NS, VirtualClock


class JumpingClock(VirtualClock):
    """Goes with the loop's virtual time until it is told to jump: back, as a restarted simulator's does, which begins
    a new epoch, or ahead."""

    def __init__(self) -> None:
        self.epoch = 0
        self._offset_ns = 0
        self._jumped = asyncio.Event()

    def now_ns(self) -> int:
        return super().now_ns() + self._offset_ns

    def jump_to(self, now_s: float) -> None:
        """Back in time: a new epoch. Ahead: just later."""
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
                # The loop counts in floats: it may be a nanosecond short.
                self._offset_ns += max(when_ns - self.now_ns(), 0)
        return self.epoch == epoch
