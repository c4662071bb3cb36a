"""What a network carries: the size and quality of the frames that a reader asks for, by how long they take."""

from __future__ import annotations

from math import inf
from typing import NamedTuple


class Level(NamedTuple):
    """How small a frame is packed."""

    divisor: int
    """Of its sides."""
    quality: int
    """Of the JPEG picture."""


LEVELS = (Level(1, 90), Level(1, 75), Level(1, 50), Level(2, 90), Level(2, 75), Level(2, 50))
"""From the best to the smallest; each takes about 0.6 times the bytes of the one before it."""
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
FAR_S = 3 * LATE_S
"""A frame that is so late needs no second one."""


class Pace:
    """Chooses the level. It begins at the smallest, which shows the network's least time, and becomes better as long as
    frames come in time; one frame after the other is asked for, so the rate follows by itself."""

    def __init__(self) -> None:
        self._at = len(LEVELS) - 1
        self._least_s = inf
        """The least time that a frame has taken."""
        self._patience = QUICK
        self._good = 0
        self._late = 0
        self._since_better = SOON + 1
        self.losses = 0

    @property
    def level(self) -> Level:
        return LEVELS[self._at]

    def arrived(self, took_s: float) -> None:
        """A frame has arrived. `took_s`: from the question to the answer, without the time that the packer held it."""
        self._least_s = min(self._least_s, took_s)
        longer_s = took_s - self._least_s
        self._since_better += 1
        if longer_s > LATE_S:
            self._late += 1
            self._good = 0
            if self._at == len(LEVELS) - 1:
                if self._late >= LONGER:
                    self._least_s = took_s
                    self._late = 0
            elif self._late > 1 or longer_s > FAR_S:
                self._worse(1)
            return
        self._late = 0
        self._good += 1
        if self._good >= self._patience and longer_s * GROWTH <= LATE_S and self._at > 0:
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
        self._at = min(self._at + steps, len(LEVELS) - 1)
        self._good = self._late = 0
        self._since_better = SOON + 1
