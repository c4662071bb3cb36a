"""The pictures for viewers: each frame is encoded once for each level that somebody looks at, in a thread of its own.

A viewer has at most one picture on its way. So a viewer whose network is slow gets coarser pictures, and fewer, but
never older ones.
"""

from __future__ import annotations

import asyncio
import os
import struct
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from cocoro.arrays import ImageArray
from cocoro.clock import NS
from cocoro.messages import Frame
from cocoro.pace import Pace

LATE_S = 0.1
"""A picture may take this much longer than the network's least time, from its sending to the page's acknowledgement."""
LOST_S = 3.0
"""A picture that is not acknowledged after this counts as lost; then one more is sent."""
EARLY = 0.25
"""A frame counts as due so many periods before its time: the camera's frames do not come at our times."""
NICER = 10
"""What the encoding thread yields to the others of this machine, in steps of niceness."""
_LENGTH = struct.Struct("<I")


class Level(NamedTuple):
    """How coarse a picture is."""

    divisor: int
    """Of its sides."""
    quality: int
    """Of the JPEG."""


def levels(quality: int) -> tuple[Level, ...]:
    """From the best to the coarsest; each takes about 0.6 times the bytes of the one before it."""
    low = max(quality * 2 // 3, 10)
    return (Level(1, quality), Level(1, low), Level(2, quality), Level(2, low), Level(4, quality), Level(4, low))


class Looking:
    """Whether one viewer wants a picture now, and how coarse. Times are of one steady clock, s."""

    def __init__(self, chosen: tuple[Level, ...]) -> None:
        self.on = True
        """Whether the viewer looks at pictures at all."""
        self._pace = Pace(chosen, LATE_S)
        self._stamp_ns: int | None = None
        self._sent_s = 0.0

    @property
    def level(self) -> Level:
        return self._pace.level

    def wants(self, now_s: float) -> bool:
        """Whether a picture may be sent."""
        if self._stamp_ns is not None and now_s - self._sent_s > LOST_S:
            self._pace.lost()
            self._stamp_ns = None
        return self.on and self._stamp_ns is None

    def sent(self, stamp_ns: int, now_s: float) -> None:
        """A picture is on its way."""
        self._stamp_ns, self._sent_s = stamp_ns, now_s

    def seen(self, stamp_ns: int, now_s: float) -> None:
        """The page has shown a picture. Of any other than the one on its way nothing follows."""
        if stamp_ns == self._stamp_ns:
            self._pace.arrived(now_s - self._sent_s)
            self._stamp_ns = None


class Viewing(NamedTuple):
    """A viewer as the pictures know it."""

    looking: Looking
    send: Callable[[bytes], None]
    """Takes a picture with its header."""


class Pictures:
    """Turns frames into pictures for those who look. `take` gets each frame."""

    def __init__(
        self,
        fps: float,
        marks: Callable[[int, int, int], dict[str, Any]],
        now_ns: Callable[[], int],
        *,
        threaded: bool = True,
    ) -> None:
        """`marks(stamp_ns, width, height)` gives what is drawn into a picture; `threaded`: encode beside the loop,
        which virtual time does not allow."""
        self._period_ns = round(NS / fps)
        self._marks = marks
        self._now_ns = now_ns
        self._thread = ThreadPoolExecutor(1, "pictures", _yield) if threaded else None
        self._due_ns: int | None = None
        """When the next picture is due, by the frames' stamps."""
        self._busy = False
        self.encoded = 0
        """Pictures that were encoded, for whomever."""

    def take(self, frame: Frame, viewers: Iterable[Viewing], *, at_once: bool = False) -> asyncio.Future[None] | None:
        """Encode a frame for those of the viewers that may get one now, if it is due, or `at_once`."""
        if self._busy or not (at_once or self._due(frame.stamp_ns)):
            return None
        now_s = asyncio.get_running_loop().time()
        wanting = [viewer for viewer in viewers if viewer.looking.wants(now_s)]
        if not wanting:
            return None
        self._plan(frame.stamp_ns)
        self._busy = True
        for viewer in wanting:
            viewer.looking.sent(frame.stamp_ns, now_s)
        return asyncio.ensure_future(self._encode(frame, wanting))

    def _due(self, stamp_ns: int) -> bool:
        if self._due_ns is None or stamp_ns < self._due_ns - 2 * self._period_ns:  # nothing yet, or a clock jumped back
            return True
        return stamp_ns >= self._due_ns - EARLY * self._period_ns

    def _plan(self, stamp_ns: int) -> None:
        """A frame was taken. The next one is due a period after this one was due, so that a viewer who was not ready in
        time makes one picture late, and none the fewer."""
        due_ns = stamp_ns if self._due_ns is None else self._due_ns
        latest_ns = stamp_ns + round(EARLY * self._period_ns)
        self._due_ns = min(max(due_ns, stamp_ns - self._period_ns), latest_ns) + self._period_ns

    async def _encode(self, frame: Frame, wanting: list[Viewing]) -> None:
        groups: dict[Level, list[Viewing]] = {}
        for viewer in wanting:
            groups.setdefault(viewer.looking.level, []).append(viewer)
        loop = asyncio.get_running_loop()
        try:
            for level, viewers in groups.items():
                if self._thread is None:
                    jpeg = encode(frame, level)
                else:
                    jpeg = await loop.run_in_executor(self._thread, encode, frame, level)
                self.encoded += 1
                picture = self._packed(frame, level, jpeg)
                now_s = loop.time()
                for viewer in viewers:
                    viewer.looking.sent(frame.stamp_ns, now_s)  # the time of encoding is not the network's
                    viewer.send(picture)
        finally:
            self._busy = False

    def _packed(self, frame: Frame, level: Level, jpeg: bytes) -> bytes:
        width, height = frame.width // level.divisor, frame.height // level.divisor
        header = {
            "stamp_ns": frame.stamp_ns,
            "now_ns": self._now_ns(),
            "width": width,
            "height": height,
            "level": f"{level.divisor}/{level.quality}",
            "marks": self._marks(frame.stamp_ns, width, height),
        }
        text = msgspec.json.encode(header)
        return _LENGTH.pack(len(text)) + text + jpeg

    def close(self) -> None:
        """End the thread; what it encodes now is its last."""
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)


def encode(frame: Frame, level: Level) -> bytes:
    """The frame's colour as JPEG."""
    image: ImageArray = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
    if level.divisor > 1:
        size = frame.width // level.divisor, frame.height // level.divisor
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, level.quality])
    if not done:
        raise RuntimeError("OpenCV encoded no JPEG")
    return jpeg.tobytes()


def _yield() -> None:
    cv2.setNumThreads(1)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
