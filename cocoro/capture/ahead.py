"""Reads and unpacks a file's blocks in a thread, while the caller works on the one before."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from cocoro.capture.contents import Disk, MessageBlock, read_block

Raw = bytes | memoryview
AHEAD = 4
"""Blocks that the thread reads and unpacks ahead."""


def read_ahead(disk: Disk, places: Iterable[MessageBlock], strict: bool) -> Iterator[tuple[MessageBlock, Future[Raw]]]:
    """Each block with its records, which may not be there yet; `strict` as in `contents.unpacked`. A result raises
    DamageError or OSError."""
    pool = ThreadPoolExecutor(1, "capture reader")
    ahead: deque[tuple[MessageBlock, Future[Raw]]] = deque()
    try:
        for place in places:
            ahead.append((place, pool.submit(read_block, disk, place, strict)))
            if len(ahead) > AHEAD:
                yield ahead.popleft()
        while ahead:
            yield ahead.popleft()
    finally:
        # Without waiting: a reader that was left in the middle may be collected in the pool's own thread.
        pool.shutdown(wait=False, cancel_futures=True)
