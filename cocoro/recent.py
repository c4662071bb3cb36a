"""How much there was of something in the last seconds, for what is to be told for a while after it happened."""

from __future__ import annotations

from collections import deque

from cocoro.clock import NS

WINDOW_S = 10.0


class Recent:
    """Add amounts as they happen; `total` forgets what is older than the window. Any clock, but always the same."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * NS)
        self._amounts: deque[tuple[int, int]] = deque()
        self._total = 0

    def add(self, amount: int, now_ns: int) -> None:
        if amount > 0:
            self._amounts.append((now_ns, amount))
            self._total += amount

    def total(self, now_ns: int) -> int:
        """A clock that began anew begins this anew, too."""
        while self._amounts and not 0 <= now_ns - self._amounts[0][0] <= self._window_ns:
            self._total -= self._amounts.popleft()[1]
        return self._total
