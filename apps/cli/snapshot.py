"""A picture of what the robot sees: a frame with the detections that were made in that very frame."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from pathlib import Path
from typing import Any

from apps.cli import exits
from apps.cli.link import Link, joined, within
from apps.cli.options import RobotChoice
from cocoro.errors import ConfigError, MeshError
from cocoro.inbox import Inbox
from cocoro.messages import Detections, Frame
from cocoro.topics import DETECTIONS, FRAME

KEPT_FRAMES = 45
"""Frames that wait for their detections: perception may be that far behind."""
FRAME_S = 5.0
DETECTIONS_S = 3.0
"""How long to wait for a frame at all, and for what was detected in one."""


async def snapshot(where: RobotChoice, out: Path) -> int:
    check(out)
    async with joined(where, frames=True) as link:
        camera = SnapshotTaker(link)
        camera.open()
        print(await camera.write(out))
    return exits.DONE


def check(out: Path) -> None:
    """Raises ConfigError when that cannot be a picture's file."""
    if out.suffix.lower() != ".png":
        raise ConfigError(f"{out}: the picture is a PNG, so let its name end with .png")


class SnapshotTaker:
    """The newest frame whose detections are known, from `open` on; `write` it when the moment has come."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._inboxes: list[Inbox[Any]] = []
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._pair: tuple[Frame, Detections] | None = None
        self._changed = asyncio.Event()

    def open(self) -> None:
        frames, detections = self._link.inbox(FRAME), self._link.inbox(DETECTIONS)
        frames.add(lambda _key, frame: self._on_frame(frame))
        detections.add(lambda _key, seen: self._on_detections(seen))
        self._inboxes = [frames, detections]

    async def write(self, out: Path) -> str:
        """Write the picture and close; says in words what it shows. Raises MeshError when the robot sends no frames."""
        try:
            if not await within(FRAME_S, lambda: bool(self._frames or self._pair), self._changed):
                raise MeshError(f"no frame from the camera within {FRAME_S:g} s: `cocoro status` tells more")
            await within(DETECTIONS_S, lambda: self._pair is not None, self._changed)
        finally:
            for inbox in self._inboxes:
                assert inbox.subscription is not None
                inbox.subscription.close()
        frame, detections = self._pair or (next(reversed(self._frames.values())), None)
        _write(out, frame, detections)
        if detections is None:
            return f"{out}: {frame.width} x {frame.height}, without detections (perception is silent)"
        labels = ", ".join(sorted(detection.label for detection in detections.detections)) or "nothing known"
        return f"{out}: {frame.width} x {frame.height}, {labels}"

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
        while next(iter(self._frames)) != of:  # older ones are of no use any more
            self._frames.popitem(last=False)
        del self._frames[of]
        self._changed.set()


def _write(out: Path, frame: Frame, detections: Detections | None) -> None:
    from cocoro import picture  # brings the image library
    from cocoro.objects import Catalogue

    picture.save_png(picture.draw(frame, detections, Catalogue.load()), out)
