"""Fetches frames from the packer, one after the other: the next is asked for when the last has arrived.

So at most one frame of a reader is on the way, and no queue of old ones can form, however slow the network is: who asks
gets the newest. Each reader asks for the size that his own way carries (`cocoro.pace`); a slow viewer takes
nothing from perception.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from cocoro.errors import CallTimeoutError, CocoroError, RemoteError
from cocoro.messages import Frame, PackedFrame, PackedRequest
from cocoro.pace import Pace
from cocoro.topics import PACKED, Request
from services.frames.pace import LEVELS
from services.frames.packing import unpack

AGAIN_S = 0.2
"""Pause after an error, before the next question."""
BEST_S = 10.0
"""Longest wait for one frame that is asked for at its best."""


class Asking(Protocol):
    """Who can call a request: a node, a command."""

    async def call(
        self, request: Request[PackedRequest, PackedFrame], question: PackedRequest, timeout_s: float | None = None
    ) -> PackedFrame: ...


class PackedReader:
    """Call `run`, which never returns; it calls `deliver` with each frame."""

    def __init__(self, asking: Asking, deliver: Callable[[Frame], None], *, best: bool = False) -> None:
        """`best`: pictures as good as they can be, however late they come."""
        self.pace = Pace(LEVELS)
        self.trouble = "no frame has arrived yet"
        """Why no frame comes; '' when one has come."""
        self.refused = 0
        """Answers that were damaged."""
        self.frames = 0
        self.octets = 0
        """Bytes that arrived."""
        self._asking = asking
        self._deliver = deliver
        self._best = best
        self._last = (0, -1)

    async def run(self) -> None:
        while True:
            if not await self._fetch():
                await asyncio.sleep(AGAIN_S)

    async def _fetch(self) -> bool:
        """One question; False when the next is better not put at once."""
        now_s = asyncio.get_running_loop().time
        divisor, quality = LEVELS[0] if self._best else self.pace.level
        question = PackedRequest(
            after_incarnation=self._last[0], after_seq=self._last[1], divisor=divisor, quality=quality
        )
        asked_s = now_s()
        try:
            packed = await self._asking.call(PACKED, question, BEST_S if self._best else None)
        except CallTimeoutError:
            self.pace.lost()
            self.trouble = "a frame that was asked for has not come in time"
            return True
        except RemoteError as error:
            self.trouble = str(error)
            return True  # the packer has waited for a frame
        except CocoroError as error:
            self.trouble = str(error)
            return False
        self.pace.arrived(max(now_s() - asked_s - packed.held_s, 0.0))
        try:
            frame = unpack(packed)
        except ValueError as error:
            self.refused += 1
            self.trouble = f"a packed frame is refused: {error}"
            return False
        if (frame.incarnation, frame.seq) == self._last:
            return False
        self.frames += 1
        self.octets += len(packed.colour) + len(packed.depth)
        self._last = (frame.incarnation, frame.seq)
        self.trouble = ""
        self._deliver(frame)
        return True
