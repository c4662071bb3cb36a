"""What a network carries: a level of size and quality, by how long what was sent at it takes.

For senders of pictures that send the next one only when the last has arrived. So the rate follows by itself, no queue
of old pictures forms, and what is left to choose is how large each is.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Generic, TypeVar

L = TypeVar("L")

LATE_S = 0.05
"""A frame may take this much longer than the network's least time. It bounds what a state, which shares the link with
it, has to wait; a base's state is old after 0.15 s."""
GROWTH = 2.0
"""A better level is tried when a frame that takes this many times as long would not be late."""
LONGER = 10
"""So many smallest frames one after the other that are late show that the way has become longer, and is not full."""
PATIENCE, MOST_PATIENCE = 10, 320
"""Frames in time before a better level is tried; doubled each time it was too much."""
QUICK = 2
"""The same before the first late frame."""
SOON = 5
"""A frame that is late so soon after the level became better shows that it was too much."""
FAR = 3.0
"""A frame that is so many times as late needs no second one."""


class Pace(Generic[L]):
    """Chooses the level. It begins at the smallest, which shows the network's least time, and becomes better as long as
    frames come in time; one frame after the other is asked for, so the rate follows by itself."""

    def __init__(self, levels: Sequence[L], late_s: float = LATE_S) -> None:
        """`levels` from the best to the smallest; each takes about 0.6 times the bytes of the one before it. A picture
        is late that takes `late_s` longer than the network's least time."""
        self._levels = levels
        self._late_s = late_s
        self._at = len(levels) - 1
        self._least_s = inf
        """The least time that a frame has taken."""
        self._patience = QUICK
        self._good = 0
        self._late = 0
        self._since_better = SOON + 1
        self.losses = 0

    @property
    def level(self) -> L:
        return self._levels[self._at]

    def arrived(self, took_s: float) -> None:
        """A frame has arrived. `took_s`: from the question to the answer, without the time that the packer held it."""
        self._least_s = min(self._least_s, took_s)
        longer_s = took_s - self._least_s
        self._since_better += 1
        if longer_s > self._late_s:
            self._late += 1
            self._good = 0
            if self._at == len(self._levels) - 1:
                if self._late >= LONGER:
                    self._least_s = took_s
                    self._late = 0
            elif self._late > 1 or longer_s > FAR * self._late_s:
                self._worse(1)
            return
        self._late = 0
        self._good += 1
        if self._good >= self._patience and longer_s * GROWTH <= self._late_s and self._at > 0:
            self._at -= 1
            self._good = 0
            self._since_better = 0
        elif self._at == 0 and self._good >= MOST_PATIENCE:
            self._patience = PATIENCE

    def lost(self) -> None:
        """A frame that was asked for has not arrived."""
        self.losses += 1
        self._worse(2)

    def _worse(self, steps: int) -> None:
        self._patience = min(2 * self._patience, MOST_PATIENCE) if self._since_better <= SOON else PATIENCE
        self._patience = max(self._patience, PATIENCE)
        self._at = min(self._at + steps, len(self._levels) - 1)
        self._good = self._late = 0
        self._since_better = SOON + 1
