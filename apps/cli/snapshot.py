"""`cocoro snapshot`: a picture of what the robot sees, with the detections of that very frame drawn in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.cli import exits
from apps.cli.link import MeshLink, joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import tell
from apps.client.seeing import FramePairs
from cocoro.errors import ConfigError
from cocoro.messages import Detections, Frame

if TYPE_CHECKING:
    from cocoro.objects import Catalogue

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
        self._pairs = FramePairs(link)
        self.labels: list[str] | None = None
        """The detections of the written picture's frame; None when perception is silent."""

    def open(self) -> None:
        self._pairs.open()

    async def write(self, out: Path) -> str:
        """Writes the picture, closes, and returns a line about it. Raises MeshError when the robot sends no frames."""
        frame, detections = await self._pairs.take()
        _write(out, frame, detections, self._link.catalogue())
        if detections is None:
            return f"{out}: {frame.width} x {frame.height}, without detections (none came from perception)"
        self.labels = sorted(detection.label for detection in detections.detections)
        return f"{out}: {frame.width} x {frame.height}, {', '.join(self.labels) or 'nothing known'}"


def _write(out: Path, frame: Frame, detections: Detections | None, catalogue: Catalogue) -> None:
    from apps import pictures  # imports the image library

    pictures.save_png(pictures.draw(frame, detections, catalogue), out)
