"""What is done with a Kinect by hand, while its service is down: views of a chessboard, from the device or from files.

The commands are `cocoro kinect ...`; whoever calls takes what is to be told.
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
from cocoro.picture import load as load_picture
from cocoro.picture import save as save_picture
from services.kinect.calibration import Board, BoardView, find_corners
from services.kinect.camera import open_device
from services.kinect.config import KinectConfig
from services.kinect.device import DepthCamera, RawFrame
from services.kinect.lens import NO_DATA

STILL_PX = 0.7
"""A board whose corners move less from picture to picture is held still."""
STILL_SHOTS = 5
NEW_PX = 25.0
"""A view is another one when a corner is so far from where it was in every view so far (mean of all corners)."""
PATIENCE_S = 60.0
"""Without a new view for so long, what there is has to do."""

Tell = Callable[[str], None]


class ViewCollector:
    """Told of every shot; keeps one view each time that the board is held still somewhere new. Pure."""

    def __init__(self, board: Board, folder: Path | None = None) -> None:
        self.views: list[BoardView] = []
        self._board = board
        self._folder = folder
        self._still: list[RawFrame] = []
        self._before: FloatArray | None = None
        self._places: list[FloatArray] = []

    def take(self, shot: RawFrame) -> str:
        """What there is to tell of a shot: '' when nothing."""
        rough = find_corners(shot.colour, self._board, quick=True)
        before, self._before = self._before, rough
        if rough is None:
            self._still.clear()
            return "the board is not seen whole"
        if before is None or _apart_px(rough, before) > STILL_PX:
            self._still.clear()
            return "hold it still"
        if any(_apart_px(rough, place) < NEW_PX for place in self._places):
            self._still.clear()
            return "now elsewhere, or tilted another way"
        self._still.append(shot)
        if len(self._still) < STILL_SHOTS:
            return ""
        return self._keep(rough)

    def _keep(self, place: FloatArray) -> str:
        shots, self._still = self._still, []
        corners = find_corners(shots[-1].colour, self._board)
        if corners is None:
            return "the board is not seen whole"
        view = BoardView(corners, mean_depth([shot.depth for shot in shots]))
        self.views.append(view)
        self._places.append(place)
        if self._folder is not None:
            save(self._folder, len(self.views), shots[-1].colour, view.depth)
        return f"view {len(self.views)}"


def mean_depth(depths: list[CodeArray]) -> CodeArray:
    """The codes in the middle, of pictures of something that stood still; no data where one of them has none."""
    stack = np.stack(depths)
    middle = np.median(stack, axis=0).astype(np.uint16)
    return np.where((stack >= NO_DATA).any(axis=0), np.uint16(NO_DATA), middle)


def capture(config: KinectConfig, board: Board, wanted: int, folder: Path | None, tell: Tell) -> list[BoardView]:
    """Views from the device. Raises ConfigError where its library is missing, CocoroError where nothing comes of it."""
    if folder is not None:
        _prepare(folder)
    return asyncio.run(_capture(config, ViewCollector(board, folder), wanted, tell))


async def _capture(config: KinectConfig, collector: ViewCollector, wanted: int, tell: Tell) -> list[BoardView]:
    told = ""

    def say(text: str) -> None:
        nonlocal told
        if text and text != told:
            told = text
            tell(f"{text} of {wanted}" if text.startswith("view") else text)

    logging.getLogger("cocoro.kinect").setLevel(logging.ERROR)
    loop = asyncio.get_running_loop()
    with closing(open_device(config, RealClock(), say)) as camera:
        newest_s = loop.time()
        async with aclosing(_shots(camera)) as shots:
            async for shot in shots:
                if shot is not None:
                    views = len(collector.views)
                    say(await asyncio.to_thread(collector.take, shot))
                    if len(collector.views) > views:
                        newest_s = loop.time()
                if len(collector.views) >= wanted:
                    break
                if loop.time() - newest_s > PATIENCE_S:
                    say(f"nothing new in {PATIENCE_S:.0f} s")
                    break
    return collector.views


async def _shots(camera: DepthCamera) -> AsyncGenerator[RawFrame | None, None]:
    """The camera's, and None once a second while it has none."""
    shots = camera.frames()
    coming: asyncio.Future[RawFrame] | None = None
    try:
        while True:
            coming = coming or asyncio.ensure_future(anext(shots))
            done, _ = await asyncio.wait([coming], timeout=1.0)
            if done:
                shot, coming = coming.result(), None
                yield shot
            else:
                yield None
    finally:
        if coming is not None:
            coming.cancel()


def tilt(config: KinectConfig, angle_rad: float) -> None:
    """Move the device's own tilt motor. Raises CocoroError where there is no device."""
    asyncio.run(_tilt(config, angle_rad))


async def _tilt(config: KinectConfig, angle_rad: float) -> None:
    faults: list[str] = []
    with closing(open_device(config, RealClock(), faults.append)) as camera:
        camera.tilt(angle_rad)
        async with aclosing(_shots(camera)) as shots:
            async for shot in shots:
                if shot is not None:
                    return
                if len(faults) > 1:
                    raise CocoroError(faults[-1])


# --- views in files -------------------------------------------------------------------------------


def save(folder: Path, number: int, colour: ImageArray, depth: CodeArray) -> None:
    """As two PNG files, the depth's of 16 bits."""
    for what, picture in (("colour", cv2.cvtColor(colour, cv2.COLOR_RGB2BGR)), ("depth", depth)):
        file = folder / f"view-{number:02}-{what}.png"
        try:
            save_picture(picture, file)
        except OSError as error:
            raise ConfigError(f"{file} cannot be written: {error.strerror}; choose another place") from error


def read(folder: Path, board: Board, tell: Tell) -> list[BoardView]:
    """The views that `save` has put there; those without a whole board are told of and left out. Raises ConfigError."""
    views = []
    for file, colour, depth in _pictures(folder):
        corners = find_corners(colour, board)
        if corners is None:
            tell(f"{file.name}: the board is not seen whole")
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
            raise ConfigError(f"{file} and {other.name} are no view: a colour picture, and one of 16 bits and its size")
        yield file, np.asarray(cv2.cvtColor(colour, cv2.COLOR_BGR2RGB), np.uint8), np.asarray(depth, np.uint16)


def _prepare(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be made: {error.strerror}") from error
    if any(folder.glob("view-*.png")):
        raise ConfigError(f"{folder} holds views already: name another folder, or use them with --from")


def _apart_px(one: FloatArray, other: FloatArray) -> float:
    """Mean distance of the corners; which of them is the first is no difference where a board looks the same turned."""
    return min(float(np.linalg.norm(one - order, axis=1).mean()) for order in (other, other[::-1]))
