"""Manual work on a Kinect while its service is down: views of a chessboard, from the device or from files; its tilt.

The commands are `cocoro kinect ...`. `show` displays a line to the operator.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing, closing
from pathlib import Path

import cv2
import numpy as np

from cocoro.arrays import CodeArray, FloatArray, ImageArray
from cocoro.clock import RealClock
from cocoro.errors import CocoroError, ConfigError
from services.kinect.calibration import Board, BoardView, find_corners
from services.kinect.camera import open_device
from services.kinect.device import DepthCamera, KinectConfig, RawFrame
from services.kinect.lens import NO_DATA
from services.kinect.picture import load as load_picture
from services.kinect.picture import save as save_picture

STILL_PX = 0.7
"""The board is held still when its corners move less than this between frames (mean of all corners)."""
STILL_FRAMES = 5
NEW_PX = 25.0
"""A view is new when the corners are further than this from their places in every earlier view (mean of all
corners)."""
PATIENCE_S = 60.0
"""Time without a new view after which no more are awaited."""


class ViewCollector:
    """Keeps one view each time that the board is held still in a new place. Pure, except that it saves the views."""

    def __init__(self, board: Board, folder: Path | None = None) -> None:
        self.views: list[BoardView] = []
        self._board = board
        self._folder = folder
        self._still: list[RawFrame] = []
        self._before: FloatArray | None = None
        self._places: list[FloatArray] = []

    def take(self, frame: RawFrame) -> str:
        """Take a frame; returns a line for the operator, or ''. Raises CocoroError for one without depth."""
        if frame.depth is None:
            raise CocoroError("this camera measures no depth: the calibration is that of a Kinect")
        rough = find_corners(frame.colour, self._board, quick=True)
        before, self._before = self._before, rough
        if rough is None:
            self._still.clear()
            return "the board is not seen whole"
        if before is None or _apart_px(rough, before) > STILL_PX:
            self._still.clear()
            return "hold it still"
        if any(_apart_px(rough, place) < NEW_PX for place in self._places):
            self._still.clear()
            return "now move it elsewhere, or tilt it another way"
        self._still.append(frame)
        if len(self._still) < STILL_FRAMES:
            return ""
        return self._keep(rough)

    def _keep(self, place: FloatArray) -> str:
        frames, self._still = self._still, []
        corners = find_corners(frames[-1].colour, self._board)
        if corners is None:
            return "the board is not seen whole"
        view = BoardView(corners, median_depth([frame.depth for frame in frames if frame.depth is not None]))
        self.views.append(view)
        self._places.append(place)
        if self._folder is not None:
            save(self._folder, len(self.views), frames[-1].colour, view.depth)
        return f"view {len(self.views)}"


def median_depth(depths: list[CodeArray]) -> CodeArray:
    """The median of depth images (height, width) of a still scene, codes; no data where one of them has none."""
    stack = np.stack(depths)
    middle = np.median(stack, axis=0).astype(np.uint16)
    return np.where((stack >= NO_DATA).any(axis=0), np.uint16(NO_DATA), middle)


def capture(
    config: KinectConfig, board: Board, wanted: int, folder: Path | None, show: Callable[[str], None]
) -> list[BoardView]:
    """Collect `wanted` views from the device. Raises ConfigError when its library is missing or `folder` cannot be
    used."""
    if folder is not None:
        _prepare(folder)
    return asyncio.run(_capture(config, ViewCollector(board, folder), wanted, show))


async def _capture(
    config: KinectConfig, collector: ViewCollector, wanted: int, show: Callable[[str], None]
) -> list[BoardView]:
    shown = ""

    def show_new(text: str) -> None:
        nonlocal shown
        if text and text != shown:
            shown = text
            show(f"{text} of {wanted}" if text.startswith("view") else text)

    logging.getLogger("cocoro.kinect").setLevel(logging.ERROR)
    loop = asyncio.get_running_loop()
    with closing(open_device(config, RealClock(), show_new)) as camera:
        newest_s = loop.time()
        async with aclosing(_frames(camera)) as frames:
            async for frame in frames:
                if frame is not None:
                    views = len(collector.views)
                    show_new(await asyncio.to_thread(collector.take, frame))
                    if len(collector.views) > views:
                        newest_s = loop.time()
                if len(collector.views) >= wanted:
                    break
                if loop.time() - newest_s > PATIENCE_S:
                    show_new(f"nothing new in {PATIENCE_S:.0f} s")
                    break
    return collector.views


async def _frames(camera: DepthCamera) -> AsyncGenerator[RawFrame | None, None]:
    """The camera's frames, and None once a second while there are none."""
    frames = camera.frames()
    coming: asyncio.Future[RawFrame] | None = None
    try:
        while True:
            coming = coming or asyncio.ensure_future(anext(frames))
            done, _ = await asyncio.wait([coming], timeout=1.0)
            if done:
                frame, coming = coming.result(), None
                yield frame
            else:
                yield None
    finally:
        if coming is not None:
            coming.cancel()


def tilt(config: KinectConfig, angle_rad: float) -> None:
    """Move the device's own tilt motor. Raises CocoroError when there is no device."""
    asyncio.run(_tilt(config, angle_rad))


async def _tilt(config: KinectConfig, angle_rad: float) -> None:
    faults: list[str] = []
    with closing(open_device(config, RealClock(), faults.append)) as camera:
        camera.tilt(angle_rad)
        async with aclosing(_frames(camera)) as frames:
            async for frame in frames:
                if frame is not None:
                    return
                if len(faults) > 1:
                    raise CocoroError(faults[-1])


# --- views in files -------------------------------------------------------------------------------


def save(folder: Path, number: int, colour: ImageArray, depth: CodeArray) -> None:
    """Save a view as two PNG files: colour (height, width, 3), and depth codes (height, width) with 16 bits. Raises
    ConfigError when they cannot be written."""
    for kind, picture in (("colour", cv2.cvtColor(colour, cv2.COLOR_RGB2BGR)), ("depth", depth)):
        file = folder / f"view-{number:02}-{kind}.png"
        try:
            save_picture(picture, file)
        except OSError as error:
            raise ConfigError(f"{file} cannot be written: {error.strerror}; choose another place") from error


def read(folder: Path, board: Board, show: Callable[[str], None]) -> list[BoardView]:
    """Read the views that `save` wrote. Views without a whole board are reported and left out. Raises ConfigError when
    there are none, or a file is damaged."""
    views = []
    for file, colour, depth in _pictures(folder):
        corners = find_corners(colour, board)
        if corners is None:
            show(f"{file.name}: the board is not seen whole")
        else:
            views.append(BoardView(corners, depth))
    return views


def _pictures(folder: Path) -> Iterator[tuple[Path, ImageArray, CodeArray]]:
    files = sorted(folder.glob("view-*-colour.png"))
    if not files:
        raise ConfigError(f"{folder} holds no views: view-01-colour.png, view-01-depth.png and so on")
    for file in files:
        colour = load_picture(file)
        other = file.with_name(file.name.replace("-colour", "-depth"))
        depth = load_picture(other, cv2.IMREAD_UNCHANGED) if other.exists() else None
        if colour is None or depth is None or depth.dtype != np.uint16 or depth.shape != colour.shape[:2]:
            raise ConfigError(
                f"{file} and {other.name} are not a view: a colour picture, and a 16-bit one of the same size"
            )
        yield file, np.asarray(cv2.cvtColor(colour, cv2.COLOR_BGR2RGB), np.uint8), np.asarray(depth, np.uint16)


def _prepare(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be made: {error.strerror}") from error
    if any(folder.glob("view-*.png")):
        raise ConfigError(f"{folder} holds views already: name another folder, or use them with --from")


def _apart_px(one: FloatArray, other: FloatArray) -> float:
    """Mean distance of the corners (n, 2), in either order, since a board may look the same turned by 180 degrees."""
    return min(float(np.linalg.norm(one - order, axis=1).mean()) for order in (other, other[::-1]))
