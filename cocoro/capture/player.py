"""A capture's time line: position, rate and the messages that are due. Pure: the caller passes the time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import MADE_HERE
from cocoro.clock import NS
from cocoro.topics import FRAME

SLOWEST, FASTEST = 0.01, 100.0
SHORTEST_PASS_NS = NS // 100
"""Lowest duration of one pass of a loop, so that a capture without length does not loop without pause."""
AT_ONCE = 256
"""Limit for the messages of one `due`, so that the event loop is not blocked."""


class Player:
    """Plays records at the spacing of their log times. All `now_s` are seconds of one steady clock."""

    def __init__(
        self,
        capture: Capture,
        chosen: Callable[[str], bool],
        *,
        start_s: float = 0.0,
        end_s: float | None = None,
        rate: float = 1.0,
        loop: bool = False,
        paused: bool = False,
    ) -> None:
        """`start_s` and `end_s` are seconds from the capture's start. `chosen(key)` selects the played keys. A
        recorder's own notes are not played, since no component published them."""
        self.keys = tuple(key for key in capture.keys if chosen(key))
        self._channels = [
            id
            for id, channel in capture.channels.items()
            if channel.topic in self.keys and channel.metadata.get("publisher") != MADE_HERE
        ]
        self.rate = rate
        self.loop = loop
        self.paused = paused
        self.passes = 0
        """How often the time line has gone back, by the loop or by `seek`."""
        self._capture = capture
        self._start_ns = capture.start_ns + round(start_s * NS)
        self._end_ns = capture.end_ns if end_s is None else capture.start_ns + round(end_s * NS) - 1
        self._turn_ns = max(self._end_ns, self._start_ns + SHORTEST_PASS_NS)
        self._next: deque[Record] = deque(maxlen=1)
        self._records: Iterator[Record] = iter(())
        self._position_ns = self._start_ns
        self._anchor_s: float | None = None
        self._step_key = next((key for key in self.keys if key.endswith(f"/{FRAME.name}")), None)
        self._stepping = False
        self._go_to(self._start_ns)

    @property
    def ended(self) -> bool:
        """Nothing is left to play, and the player neither loops nor is paused."""
        return not self._next and not self.loop and not self.paused

    @property
    def length_s(self) -> float:
        return (self._capture.end_ns - self._capture.start_ns) / NS

    def position_s(self, now_s: float) -> float:
        """Seconds from the capture's start."""
        return (min(self._now_ns(now_s), self._end_ns) - self._capture.start_ns) / NS

    def position_ns(self, now_s: float) -> int:
        """The position in the capture, as a log time, ns."""
        return min(self._now_ns(now_s), self._end_ns)

    # --- what is due ------------------------------------------------------------------------------

    def due(self, now_s: float) -> list[Record]:
        """The messages to send now, in order, at most `AT_ONCE`."""
        if self._anchor_s is None:
            self._anchor_s = now_s
        if self._stepping:
            return self._one_step()
        if not self._next and self.loop and not self.paused and self._now_ns(now_s) >= self._turn_ns:
            self._anchor(now_s, self._start_ns)
            self.passes += 1
            self._go_to(self._start_ns)
        position_ns = self._now_ns(now_s)
        found: list[Record] = []
        while not self.paused and self._next and self._next[0].log_ns <= position_ns and len(found) < AT_ONCE:
            found.append(self._take())
        return found

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next message is due; None while paused or ended."""
        if self._stepping:
            return 0.0
        if self.paused or self.ended:
            return None
        next_ns = self._next[0].log_ns if self._next else self._turn_ns
        return max((next_ns - self._now_ns(now_s)) / NS / self.rate, 0.0)

    def _one_step(self) -> list[Record]:
        self._stepping = False
        found = []
        while self._next:
            record = self._take()
            found.append(record)
            self._position_ns = record.log_ns
            if self._step_key in (None, record.key):
                break
        return found

    # --- by hand ----------------------------------------------------------------------------------

    def toggle(self, now_s: float) -> None:
        """Pause or continue."""
        self._anchor(now_s, self._now_ns(now_s))
        self.paused = not self.paused

    def step(self, now_s: float) -> None:
        """Pause after the next picture, or after the next message of a capture without pictures."""
        if not self.paused:
            self.toggle(now_s)
        self._stepping = True

    def change_rate(self, now_s: float, rate: float) -> None:
        self._anchor(now_s, self._now_ns(now_s))
        self.rate = min(max(rate, SLOWEST), FASTEST)

    def seek(self, now_s: float, to_s: float) -> None:
        """Go to a second from the capture's start, limited to the played part."""
        to_ns = min(max(self._capture.start_ns + round(to_s * NS), self._start_ns), self._end_ns)
        if to_ns < self._now_ns(now_s):
            self.passes += 1
        self._anchor(now_s, to_ns)
        self._go_to(to_ns)

    # --- the time line ----------------------------------------------------------------------------

    def _now_ns(self, now_s: float) -> int:
        if self.paused or self._anchor_s is None:
            return self._position_ns
        return self._position_ns + round((now_s - self._anchor_s) * self.rate * NS)

    def _anchor(self, now_s: float, position_ns: int) -> None:
        self._anchor_s, self._position_ns = now_s, position_ns

    def _go_to(self, start_ns: int) -> None:
        self._records = self._capture.messages(start_ns=start_ns, end_ns=self._end_ns + 1, channels=self._channels)
        self._next.clear()
        self._advance()

    def _take(self) -> Record:
        record = self._next.popleft()
        self._advance()
        return record

    def _advance(self) -> None:
        record = next(self._records, None)
        if record is not None:
            self._next.append(record)
