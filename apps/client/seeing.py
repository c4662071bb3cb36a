"""What the robot sees: one frame as arrays, and the detections of that very frame."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from contextlib import ExitStack
from functools import cached_property
from typing import TYPE_CHECKING

from apps.client.reading import reading
from cocoro.errors import MeshError
from cocoro.messages import Detection, Detections, Frame
from cocoro.participant import Participant
from cocoro.topics import DETECTIONS, FRAME
from deploy.survey import within

if TYPE_CHECKING:
    from cocoro.arrays import Float32Array, ImageArray
    from cocoro.robot import Robot

KEPT_FRAMES = 45
"""Frames that are kept until their detections arrive; perception may be this many frames late."""
FRAME_S = 5.0
"""Longest wait for the first frame."""
DETECTIONS_S = 3.0
"""Longest wait for the detections of a frame."""


class View:
    """One frame. A notebook shows it as a picture."""

    def __init__(self, frame: Frame, detections: Detections | None, robot: Robot) -> None:
        self.frame = frame
        self.detections: tuple[Detection, ...] | None = None if detections is None else detections.detections
        """The known objects in this frame; None when perception was not asked, or did not tell."""
        self._told = detections
        self._robot = robot

    @property
    def stamp_ns(self) -> int:
        """The middle of the exposure, on the robot's clock."""
        return self.frame.stamp_ns

    @property
    def labels(self) -> list[str]:
        """The labels of the detections, sorted."""
        return sorted(one.label for one in self.detections or ())

    @cached_property
    def colour(self) -> ImageArray:
        """RGB, uint8, (height, width, 3); a view of the message, not to be written to."""
        from apps.pictures import colour_of  # imports the image library

        return colour_of(self.frame)

    @cached_property
    def depth_m(self) -> Float32Array:
        """Metres along the optical axis at the pixels of `colour`, (height, width); NaN without data."""
        from services.perception.image import RgbdImage

        return RgbdImage.of(self.frame, self._robot).depth_m((0, 0, self.frame.width, self.frame.height))

    def drawn(self) -> ImageArray:
        """A copy of `colour` with the detections drawn in."""
        from apps.pictures import draw

        return draw(self.frame, self._told)

    def png(self) -> bytes:
        """The picture as a PNG file, with the detections drawn in."""
        import cv2

        _, packed = cv2.imencode(".png", cv2.cvtColor(self.drawn(), cv2.COLOR_RGB2BGR))
        return packed.tobytes()

    def _repr_png_(self) -> bytes:
        return self.png()

    def __repr__(self) -> str:
        seen = "not asked" if self.detections is None else ", ".join(self.labels) or "nothing known"
        return f"<View {self.frame.width} x {self.frame.height}: {seen}>"


class FramePairs:
    """Keeps the newest frame whose detections are known, from `open` on, until `take` has it."""

    def __init__(self, participant: Participant) -> None:
        self._participant = participant
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._pair: tuple[Frame, Detections] | None = None
        self._changed = asyncio.Event()
        self._reading = ExitStack()

    def open(self) -> None:
        self._reading.enter_context(reading(self._participant, FRAME, self._on_frame))
        self._reading.enter_context(reading(self._participant, DETECTIONS, self._on_detections))

    def close(self) -> None:
        self._reading.close()

    async def take(
        self, frame_s: float = FRAME_S, detections_s: float | None = None
    ) -> tuple[Frame, Detections | None]:
        """The newest frame with its detections, and closes; without them when perception is silent for `detections_s`
        (by default `DETECTIONS_S`), or that is 0. Raises MeshError when the robot sends no frames."""
        if detections_s is None:
            detections_s = DETECTIONS_S
        try:
            if not await within(frame_s, lambda: bool(self._frames or self._pair), self._changed):
                raise MeshError(f"no frame from the camera within {frame_s:g} s: see `cocoro status`")
            if detections_s:
                await within(detections_s, lambda: self._pair is not None, self._changed)
        finally:
            self.close()
        if self._pair is not None:
            return self._pair if detections_s else (self._pair[0], None)
        return next(reversed(self._frames.values())), None

    def _on_frame(self, frame: Frame) -> None:
        self._frames[frame.incarnation, frame.seq] = frame
        while len(self._frames) > KEPT_FRAMES:
            self._frames.popitem(last=False)
        self._changed.set()

    def _on_detections(self, detections: Detections) -> None:
        of = (detections.frame_incarnation, detections.frame_seq)
        if of not in self._frames:
            return
        self._pair = (self._frames[of], detections)
        while next(iter(self._frames)) != of:  # older frames are no longer needed
            self._frames.popitem(last=False)
        del self._frames[of]
        self._changed.set()
