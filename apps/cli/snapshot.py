"""`cocoro snapshot`: a picture of what the robot sees, with the detections of that very frame drawn in."""

from __future__ import annotations

import asyncio
import sys
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.cli import exits
from apps.cli.link import MeshLink, joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import tell
from cocoro.errors import ConfigError, MeshError
from cocoro.messages import Detections, Frame
from cocoro.topics import DETECTIONS, FRAME
from deploy.survey import within

if TYPE_CHECKING:
    from cocoro.objects import Catalogue

KEPT_FRAMES = 45
"""Frames that are kept until their detections arrive; perception may be this many frames late."""
FRAME_S = 5.0
"""Longest wait for the first frame."""
DETECTIONS_S = 3.0
"""Longest wait for the detections of a frame."""


app = typer.Typer()


@app.command()
def snapshot(
    out: Annotated[Path, typer.Argument(metavar="OUT.png", help="The picture's file.")],
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Write a picture of what the robot sees now, with its detections drawn in."""
    sys.exit(asyncio.run(take_snapshot(RobotChoice(robot, site), out, json)))


async def take_snapshot(choice: RobotChoice, out: Path, as_json: bool = False) -> int:
    """Writes the picture and returns the exit code. Raises ConfigError for a name that is not OUT.png, MeshError."""
    check(out)
    async with joined(choice, frames=True, best=True) as link:
        camera = SnapshotTaker(link)
        camera.open()
        text = await camera.write(out)
        tell(as_json, {"file": str(out), "detected": camera.labels}, text)
    return exits.DONE


def check(out: Path) -> None:
    """Raises ConfigError when the name does not end with .png."""
    if out.suffix.lower() != ".png":
        raise ConfigError(f"{out}: the picture is a PNG file, so its name must end with .png")


class SnapshotTaker:
    """Keeps the newest frame whose detections are known, from `open` on, until `write` saves it."""

    def __init__(self, link: MeshLink) -> None:
        self._link = link
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._pair: tuple[Frame, Detections] | None = None
        self._changed = asyncio.Event()
        self.labels: list[str] | None = None
        """The detections of the written picture's frame; None when perception is silent."""

    def open(self) -> None:
        frames, detections = self._link.inbox(FRAME), self._link.inbox(DETECTIONS)
        frames.add(lambda _key, frame: self._on_frame(frame))
        detections.add(lambda _key, seen: self._on_detections(seen))

    async def write(self, out: Path) -> str:
        """Writes the picture, closes, and returns a line about it. Raises MeshError when the robot sends no frames."""
        try:
            if not await within(FRAME_S, lambda: bool(self._frames or self._pair), self._changed):
                raise MeshError(f"no frame from the camera within {FRAME_S:g} s: see `cocoro status`")
            await within(DETECTIONS_S, lambda: self._pair is not None, self._changed)
        finally:
            for topic in (FRAME, DETECTIONS):
                self._link.drop(topic)
        frame, detections = self._pair or (next(reversed(self._frames.values())), None)
        _write(out, frame, detections, self._link.catalogue())
        if detections is None:
            return f"{out}: {frame.width} x {frame.height}, without detections (none came from perception)"
        self.labels = sorted(detection.label for detection in detections.detections)
        return f"{out}: {frame.width} x {frame.height}, {', '.join(self.labels) or 'nothing known'}"

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


def _write(out: Path, frame: Frame, detections: Detections | None, catalogue: Catalogue) -> None:
    from apps import pictures  # imports the image library

    pictures.save_png(pictures.draw(frame, detections, catalogue), out)
