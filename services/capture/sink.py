"""Queues between the recorder and the disk: a writer thread in real time, direct writing in virtual time."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple, Protocol

from cocoro.capture.conventions import CaptureError
from cocoro.capture.occasion import Occasion
from cocoro.messages import DisturbedFile
from services.capture.file import LARGE_BYTES
from services.capture.keys import QueuedMessage
from services.capture.occasions import OccasionNews
from services.capture.writer import CaptureWriter, sync

log = logging.getLogger(__name__)

RESERVE_BYTES = 16 * 1024 * 1024
"""Room for small messages when large ones have filled the queue."""


class RecordingProgress(NamedTuple):
    file: str = ""
    messages: int = 0
    size_bytes: int = 0
    raw_bytes: int = 0
    waiting_bytes: int = 0
    longest_sync_ms: float = 0.0
    fault: str = ""
    """Why recording has stopped; '' while it works."""
    disturbed: tuple[DisturbedFile, ...] = ()
    removed: int = 0
    left_out: Mapping[str, int] = {}
    occasion: str = ""
    task_id: str = ""
    free_bytes: int = 0
    kept_bytes: int = 0
    keep_bytes: int | None = None


class RecordingSink(Protocol):
    def offer(self, message: QueuedMessage) -> bool:
        """Returns whether the message was taken; False when the queue is full. After a fault messages are taken and
        discarded."""

    def write(self) -> None:
        """Messages have been offered: write and flush them soon."""

    def remember(self, name: str, entries: Mapping[str, str]) -> None:
        """Write metadata of the run."""

    def tell(self, what: OccasionNews, occasion: Occasion) -> None:
        """An occasion began, changed or ended."""

    def progress(self) -> RecordingProgress: ...

    def deleted(self) -> tuple[str, ...]:
        """Names of the captures that made room since the start."""

    def close(self) -> None:
        """Write everything queued and complete the file. Blocks."""


class DirectSink:
    """Writes each message directly, for virtual time. Its progress does not tell the room on the disk, so that equal
    runs make equal captures."""

    def __init__(self, make: Callable[[Callable[[int], None] | None], CaptureWriter], flush_s: float) -> None:
        self._writer: CaptureWriter | None = None
        self._fault = ""
        self._flush_ns = round(flush_s * 1e9)
        self._flushed_ns = 0
        with self._guarded():
            self._writer = make(None)

    def offer(self, message: QueuedMessage) -> bool:
        if self._writer is not None and not self._fault:
            with self._guarded():
                self._writer.put(message)
                if message.log_ns - self._flushed_ns >= self._flush_ns:
                    self._flushed_ns = message.log_ns
                    self._writer.flush()
        return True

    def write(self) -> None:
        """Each message has been written already."""

    def remember(self, name: str, entries: Mapping[str, str]) -> None:
        if self._writer is not None and not self._fault:
            with self._guarded():
                self._writer.remember(name, entries)

    def tell(self, what: OccasionNews, occasion: Occasion) -> None:
        if self._writer is not None and not self._fault:
            with self._guarded():
                self._writer.tell(what, occasion)

    def progress(self) -> RecordingProgress:
        return _progress(self._writer, 0, 0.0, self._fault)._replace(free_bytes=0)

    def deleted(self) -> tuple[str, ...]:
        return () if self._writer is None else self._writer.deleted

    def close(self) -> None:
        if self._writer is not None and not self._fault:
            with self._guarded():
                self._writer.close()

    def _guarded(self) -> _FaultReporter:
        return _FaultReporter(self._set_fault)

    def _set_fault(self, fault: str) -> None:
        self._fault = fault


class ThreadedSink:
    """Queues messages, up to a limit, for a thread that writes and flushes them when `write` is called, and every
    `flush_s`."""

    def __init__(
        self,
        make: Callable[[Callable[[int], None] | None], CaptureWriter],
        capacity_bytes: int,
        flush_s: float,
        sync_s: float,
    ) -> None:
        """`make(release)` opens the writer. It runs in the thread, so that a slow disk does not block the loop."""
        self._make = make
        self._capacity_bytes = capacity_bytes
        self._flush_s = flush_s
        self._waiting: deque[QueuedMessage | Callable[[CaptureWriter], None]] = deque()
        self._taken_bytes = 0  # written by the loop only
        self._done_bytes = 0  # written by the thread only, so no lock is needed
        self._fault = ""
        self._writer: CaptureWriter | None = None
        self._closing = False
        self._due = threading.Event()
        self._syncer = Syncer(sync_s, self._current)
        self._thread = threading.Thread(target=self._run, name="capture writer", daemon=True)
        self._thread.start()

    def offer(self, message: QueuedMessage) -> bool:
        if self._fault:
            return True
        size = len(message.payload)
        room = self._capacity_bytes + (RESERVE_BYTES if size < LARGE_BYTES else 0)
        if self._taken_bytes - self._done_bytes + size > room:
            return False
        self._taken_bytes += size
        self._waiting.append(message)
        return True

    def write(self) -> None:
        self._due.set()

    def remember(self, name: str, entries: Mapping[str, str]) -> None:
        self._ask(lambda writer: writer.remember(name, entries))

    def tell(self, what: OccasionNews, occasion: Occasion) -> None:
        self._ask(lambda writer: writer.tell(what, occasion))

    def _ask(self, work: Callable[[CaptureWriter], None]) -> None:
        if not self._fault:  # nobody takes it any more
            self._waiting.append(work)

    def progress(self) -> RecordingProgress:
        waiting_bytes = self._taken_bytes - self._done_bytes
        return _progress(self._writer, waiting_bytes, self._syncer.longest_ms, self._fault)

    def deleted(self) -> tuple[str, ...]:
        return () if self._writer is None else self._writer.deleted

    def close(self) -> None:
        self._closing = True
        self._due.set()
        self._thread.join()
        self._syncer.close()

    def _current(self) -> int | None:
        return None if self._writer is None else self._writer.file.fileno()

    def _run(self) -> None:
        with _FaultReporter(self._failed):
            self._writer = writer = self._make(self._syncer.release)
            self._syncer.start()
            while True:
                self._due.wait(self._flush_s)
                self._due.clear()
                last = self._closing
                self._write(writer)
                writer.flush()
                if last:
                    writer.close()
                    return

    def _write(self, writer: CaptureWriter) -> None:
        """Write the queued messages, with a flush whenever `flush_s` has passed."""
        flush_at_s = time.monotonic() + self._flush_s
        for _ in range(len(self._waiting)):
            item = self._waiting.popleft()
            if isinstance(item, QueuedMessage):
                writer.put(item)
                self._done_bytes += len(item.payload)
            else:
                item(writer)
            if time.monotonic() >= flush_at_s:
                writer.flush()
                flush_at_s = time.monotonic() + self._flush_s

    def _failed(self, fault: str) -> None:
        self._fault = fault
        self._waiting.clear()
        self._done_bytes = self._taken_bytes


class Syncer:
    """Calls fdatasync periodically, in a thread of its own because that blocks."""

    def __init__(
        self,
        period_s: float,
        current: Callable[[], int | None],
        sync: Callable[[int], None] = sync,
        wait: Callable[[threading.Event, float], bool] = threading.Event.wait,
    ) -> None:
        """`current` returns the descriptor of the open file."""
        self.longest_ms = 0.0
        self.count = 0
        self._period_s = period_s
        self._current = current
        self._sync = sync
        self._wait = wait
        self._whole: deque[int] = deque()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self.run, name="capture syncer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def release(self, fd: int) -> None:
        """Take over a completed file or a folder: sync and close it soon."""
        self._whole.append(fd)

    def run(self) -> None:
        while True:
            last = self._wait(self._closing, self._period_s)
            self.sync()
            if last:
                return

    def sync(self) -> None:
        """Sync the open file and the completed ones."""
        current = self._current()
        with suppress(OSError):  # closed meanwhile, and so released to the queue below
            if current is not None:
                fd = os.dup(current)
                try:
                    self._timed(fd)
                finally:
                    os.close(fd)
        while self._whole:
            fd = self._whole.popleft()
            try:
                self._timed(fd)
            finally:
                os.close(fd)

    def close(self) -> None:
        """Sync the rest."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self.sync()

    def _timed(self, fd: int) -> None:
        started = time.perf_counter()
        with suppress(OSError):  # the writer gets the same error
            self._sync(fd)
        self.count += 1
        self.longest_ms = max(self.longest_ms, (time.perf_counter() - started) * 1e3)


class _FaultReporter:
    """Reports a CaptureError, or any other exception, as the recorder's fault, so that it does not die silently."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> bool:
        if isinstance(error, CaptureError):
            self._report(f"recording has stopped: {error}")
            return True
        if isinstance(error, Exception):
            log.exception("the recorder has failed", exc_info=error)
            self._report(f"the recorder has failed: {type(error).__name__}: {error}")
            return True
        return False


def _progress(
    writer: CaptureWriter | None, waiting_bytes: int, longest_sync_ms: float, fault: str
) -> RecordingProgress:
    if writer is None:
        return RecordingProgress(waiting_bytes=waiting_bytes, fault=fault)
    return RecordingProgress(
        file=writer.where,
        messages=writer.messages,
        size_bytes=writer.size_bytes,
        raw_bytes=writer.raw_bytes,
        waiting_bytes=waiting_bytes,
        longest_sync_ms=longest_sync_ms,
        fault=fault,
        disturbed=writer.disturbed,
        removed=writer.removed,
        left_out=dict(writer.left_out),
        occasion="" if writer.occasion is None else writer.occasion.what,
        task_id="" if writer.occasion is None else writer.occasion.task_id,
        free_bytes=writer.free_bytes,
        kept_bytes=writer.kept_bytes,
        keep_bytes=writer.keep_bytes,
    )
