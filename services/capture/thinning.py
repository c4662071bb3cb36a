"""Writes whole what happens, and of the rest what is large only now and then.

While nothing happens, the large messages of the last seconds wait in memory. When an occasion begins, a new file
begins with everything of these seconds. Small messages are always written at once, so that a crash loses none of them;
the new file has those of the last seconds a second time.
"""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from cocoro.bus.base import Qos
from cocoro.capture.conventions import LEFT_OUT
from cocoro.capture.folder import IDLE, RecordingFolder
from cocoro.capture.occasion import OCCASION, Occasion
from cocoro.clock import NS
from cocoro.installed import topic_named
from services.capture.file import LARGE_BYTES
from services.capture.keys import KeyInfo, PreparedMessage, QueuedMessage
from services.capture.occasions import OccasionNews
from services.capture.packing import PackedMessage, Packer
from services.capture.writer import CaptureWriter, FileLimits, Missing, sync_and_close

KEPT_STRETCHES = 100


@dataclass(frozen=True)
class ThinningLimits:
    before_s: float
    """Seconds of everything that wait in memory."""
    before_bytes: int
    """Their size; the oldest go first."""
    period_s: float
    """While nothing happens, one large message of each key in this time is written; 0: all of them."""
    idle_file_s: float
    """A file in which nothing happens is as long as this."""


class _Held:
    """A message that waits."""

    __slots__ = ("key", "log_ns", "message", "written")

    def __init__(self, key: str, log_ns: int, message: QueuedMessage | PackedMessage, written: bool) -> None:
        self.key = key
        self.log_ns = log_ns
        self.message = message
        self.written = written
        """It is in the current file or the one before."""

    @property
    def size_bytes(self) -> int:
        return len(self.message.data if isinstance(self.message, PackedMessage) else self.message.payload)


class ThinningWriter(CaptureWriter):
    """Writes one file for each occasion, and others in between."""

    def __init__(
        self,
        folder: RecordingFolder,
        robot: str,
        thinning: ThinningLimits,
        packer: Packer,
        limits: FileLimits,
        info: Callable[[str, bytes], KeyInfo],
        missing: Callable[[], Missing],
        release: Callable[[int], None] = sync_and_close,
        prepare: Callable[[QueuedMessage], PreparedMessage] | None = None,
    ) -> None:
        folder.label = IDLE
        super().__init__(folder.place, packer, limits, info, self._with_left_out, release, prepare)
        self.folder = folder
        self._known_missing = missing
        self._robot = robot
        self._thinning = thinning
        self._before_ns = round(thinning.before_s * NS)
        self._busy_limits = limits
        self._held: deque[_Held] = deque()
        self._held_bytes = 0
        self._kept_ns: dict[str, int] = {}
        """Log time of each large key's last message that was written while nothing happened."""
        self._large: dict[str, bool] = {}
        """Whether a key's messages may be left out when they are large."""
        self._stretches: deque[list[int | None]] = deque(maxlen=KEPT_STRETCHES)
        """Log times between which large messages were left out; None: it lasts."""
        self._told: Counter[str] = Counter()
        """`left_out` when the last file ended."""
        self._newest_ns = 0
        self._set_limits()

    @property
    def kept_bytes(self) -> int:
        return self.folder.kept_bytes

    @property
    def keep_bytes(self) -> int | None:
        return self.folder.keep_bytes

    @property
    def deleted(self) -> tuple[str, ...]:
        return self.folder.deleted

    @property
    def _thins(self) -> bool:
        """Whether large messages are left out now."""
        return self.occasion is None and self._thinning.period_s > 0

    @property
    def _holds(self) -> bool:
        """Whether messages are held for the next file: not while a task runs."""
        return self.occasion is None or not self.occasion.task_id or self.occasion.ended_ns is not None

    def put(self, message: QueuedMessage) -> None:
        self._newest_ns = max(self._newest_ns, message.log_ns)
        if not self._holds:
            super().put(message)
        elif len(message.payload) >= LARGE_BYTES:
            packed = self.pack(message)
            waits = self._thins and self._may_be_left_out(message.key)
            if not waits:
                self.put_packed(packed)
            self._hold(_Held(message.key, message.log_ns, packed, written=not waits))
        else:
            super().put(message)
            self._hold(_Held(message.key, message.log_ns, message, written=True))

    def tell(self, what: OccasionNews, occasion: Occasion) -> None:
        if what == "begin":
            self._begin(occasion)
        elif what == "note" and self.occasion is not None:
            self.occasion = occasion
            self._write_occasion(occasion)
        elif what == "end" and self.occasion is not None:
            self._write_occasion(occasion)
            self._next_file(None)

    def close(self) -> None:
        """Complete the file. What still waits is left out."""
        while self._held:
            self._let_go_of(self._held.popleft(), keep=False)
        self._end_stretch()
        super().close()

    def _with_left_out(self) -> Missing:
        """The account of missing messages, with those left out of the file that is being closed."""
        here = self.left_out - self._told
        self._told = self.left_out.copy()
        return self._known_missing()._replace(left_out=dict(here))

    # --- occasions --------------------------------------------------------------------------------

    def _begin(self, occasion: Occasion) -> None:
        if self.occasion is not None:
            self.occasion.ended_ns = self.occasion.ended_ns or occasion.began_ns
            self._write_occasion(self.occasion)
        self._next_file(occasion)
        self._write_occasion(occasion)
        for held in self._held:
            self._put_held(held)
        if not self._holds:
            self._held.clear()
            self._held_bytes = 0

    def _next_file(self, occasion: Occasion | None) -> None:
        self._end_stretch()
        self.forget(OCCASION)
        self.occasion = occasion
        self.folder.label = IDLE if occasion is None else occasion.label
        self.rotate()
        self._set_limits()

    def _set_limits(self) -> None:
        busy = self._busy_limits
        self.limits = busy if self.occasion else replace(busy, file_s=max(busy.file_s, self._thinning.idle_file_s))

    def _write_occasion(self, occasion: Occasion) -> None:
        self.remember(OCCASION, occasion.entries())

    # --- what waits -------------------------------------------------------------------------------

    def _hold(self, held: _Held) -> None:
        """Keep a message, and release what has waited for long enough."""
        waiting = self._held
        waiting.append(held)
        self._held_bytes += held.size_bytes
        oldest_ns, most_bytes = self._newest_ns - self._before_ns, self._thinning.before_bytes
        while waiting and (waiting[0].log_ns < oldest_ns or self._held_bytes > most_bytes):
            held = waiting.popleft()
            self._held_bytes -= held.size_bytes
            self._let_go_of(held, keep=True)

    def _put_held(self, held: _Held) -> None:
        if isinstance(held.message, PackedMessage):
            self.put_packed(held.message)
        else:
            super().put(held.message)
        held.written = True

    def _let_go_of(self, held: _Held, keep: bool) -> None:
        if held.written:
            if isinstance(held.message, PackedMessage):
                self._kept_ns[held.key] = held.log_ns
            return
        kept_ns = self._kept_ns.get(held.key)
        if keep and (kept_ns is None or held.log_ns - kept_ns >= self._thinning.period_s * NS):
            self._kept_ns[held.key] = held.log_ns
            self._put_held(held)
            return
        self.left_out[held.key] += 1
        if not self._stretches or self._stretches[-1][1] is not None:
            self._stretches.append([held.log_ns, None])
            self._write_stretches()

    def _end_stretch(self) -> None:
        """Large messages are written again from those that wait on."""
        if self._stretches and self._stretches[-1][1] is None:
            first_ns = next((held.log_ns for held in self._held if not held.written), self._newest_ns)
            self._stretches[-1][1] = first_ns
            self._write_stretches()

    def _write_stretches(self) -> None:
        entries = {"stretches": json.dumps(list(self._stretches)), "period_s": repr(self._thinning.period_s)}
        self.remember(LEFT_OUT, entries)

    def _may_be_left_out(self, key: str) -> bool:
        """Events are written whatever their size: each of them counts."""
        if key not in self._large:
            topic = topic_named(key.removeprefix(f"{self._robot}/"))
            self._large[key] = topic is None or topic.qos is not Qos.EVENT
        return self._large[key]
