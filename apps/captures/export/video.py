"""`--video`: the camera's pictures with detections and a caption drawn in; or a simulated run from outside.

A name that ends with .mp4 is a film, one that ends with .webp a small animation for a page of text.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, get_args

import cv2

from apps.captures.export.files import making, refuse_existing
from apps.captures.export.story import Story, catalogue_of, read
from apps.pictures import captioned, draw
from cocoro.arrays import ImageArray
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError
from cocoro.topics import FRAME

CameraChoice = Literal["robot", "outside", "both"]
"""The robot's own camera; one that films the simulated robot; or this one with the robot's picture in a corner."""

RATE_HZ = 30.0
CODEC, SUFFIX = "mp4v", ".mp4"
"""MPEG-4 part 2, which OpenCV can write on every platform."""
ANIMATION = ".webp"
ANIMATION_HZ, ANIMATION_QUALITY = 10.0, 84
LONGEST_ANIMATION_S = 60.0
"""All pictures of an animation are in memory."""
OUTSIDE_PX, ANIMATION_PX = (960, 540), (640, 360)
INSET = 0.3
"""Width of the robot's picture in the corner, as a share of the whole."""
INSET_EDGE_PX, INSET_RGB = 2, (235, 235, 235)


def camera_of(name: str) -> CameraChoice:
    """Raises ConfigError for a name that is none."""
    for choice in get_args(CameraChoice):
        if choice == name:
            return choice  # type: ignore[no-any-return]
    raise ConfigError(f"--camera {name}: no such camera; known are {', '.join(get_args(CameraChoice))}")


def check(out: Path, length_s: float = 0.0) -> None:
    """Raises CaptureError when no film of this length could have this name, or the file exists."""
    refuse_existing(out)
    if out.suffix.lower() not in (SUFFIX, ANIMATION):
        raise CaptureError(f"{out}: a film's name ends with {SUFFIX}, that of a small animation with {ANIMATION}")
    if out.suffix.lower() == ANIMATION and length_s > LONGEST_ANIMATION_S:
        raise CaptureError(
            f"{out}: an animation lasts {LONGEST_ANIMATION_S:.0f} s at most, and the capture has {length_s:.0f} s; "
            f"make a film with a name that ends with {SUFFIX}"
        )


def export(
    capture: Capture, out: Path, progress: Callable[[float], None] = lambda _: None, camera: CameraChoice = "robot"
) -> int:
    """Write the film in real time: each picture is shown until the next one, and pictures beyond the film's rate are
    left out.

    Returns the number of pictures. Raises CaptureError when the capture has no pictures, or not what the view from
    outside needs, or when the film cannot be written.
    """
    check(out, (capture.end_ns - capture.start_ns) / NS)
    with making(out):
        return _export(capture, out, progress, camera)


def _export(capture: Capture, out: Path, progress: Callable[[float], None], camera: CameraChoice) -> int:
    story = Story(capture)
    animated = out.suffix.lower() == ANIMATION
    if camera == "robot":
        pictures = _seen(capture, story)
    else:
        pictures = _from_outside(capture, story, ANIMATION_PX if animated else OUTSIDE_PX, animated, camera == "both")
    film: _Pictures | None = None
    with spelt_for_opencv(out) as name, closing(Complaints()) as complaints:
        for log_ns, picture in pictures:
            at_s = (log_ns - capture.start_ns) / NS
            if film is None:
                size = picture.shape[1], picture.shape[0]
                film = _Animation(out, name, at_s) if animated else _Film(out, name, complaints, size, at_s)
            captioned(picture, _caption(story, log_ns, at_s))
            film.show(at_s, picture)
            progress(at_s)
        if film is None:
            raise CaptureError(f"{capture.path}: it has no pictures")
        return film.close()


def _seen(capture: Capture, story: Story) -> Iterator[tuple[int, ImageArray]]:
    """Log time and picture of each frame, with the detections."""
    catalogue = catalogue_of(capture)
    for record, frame in read(capture, FRAME):
        yield record.log_ns, draw(frame, story.seen_in(frame.incarnation, frame.seq), catalogue)


def _from_outside(
    capture: Capture, story: Story, size_px: tuple[int, int], fine: bool, inset: bool
) -> Iterator[tuple[int, ImageArray]]:
    """Log time and picture from outside; with `inset` the robot's newest picture is in a corner."""
    from apps.captures.export.outside import OutsideFilm
    from sim.render.outside import FAST, FINE

    seen = _seen(capture, story) if inset else iter(())
    newest: ImageArray | None = None
    waiting = next(seen, None)
    with closing(OutsideFilm(capture, story, *size_px, FINE if fine else FAST)) as film:
        for log_ns, picture in film.pictures(1 / ANIMATION_HZ if fine else 1 / RATE_HZ):
            while waiting is not None and waiting[0] <= log_ns:
                newest, waiting = waiting[1], next(seen, None)
            if newest is not None:
                _put_inset(picture, newest)
            yield log_ns, picture


def _put_inset(picture: ImageArray, inset: ImageArray) -> None:
    width = round(INSET * picture.shape[1])
    height = round(width * inset.shape[0] / inset.shape[1])
    edge, gap = INSET_EDGE_PX, picture.shape[1] // 60
    top, right = gap + edge, picture.shape[1] - gap - edge
    picture[top - edge : top + height + edge, right - width - edge : right + edge] = INSET_RGB
    picture[top : top + height, right - width : right] = cv2.resize(
        inset, (width, height), interpolation=cv2.INTER_AREA
    )


class _Pictures(Protocol):
    """Takes the pictures of a film."""

    def show(self, at_s: float, picture: ImageArray) -> None: ...

    def close(self) -> int:
        """Finish the file. Returns the number of pictures in it."""


class _Animation:
    """A WebP animation, which web pages show without a player."""

    def __init__(self, out: Path, name: str, start_s: float) -> None:
        self._out = out
        self._name = name
        self._due_s = start_s
        self._times_s: list[float] = []
        self._pictures: list[ImageArray] = []

    def show(self, at_s: float, picture: ImageArray) -> None:
        if at_s < self._due_s:
            return
        self._due_s = at_s + 0.9 / ANIMATION_HZ
        self._times_s.append(at_s)
        self._pictures.append(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR).astype("uint8"))

    def close(self) -> int:
        animation = cv2.Animation()
        animation.frames = self._pictures
        last_s = 1.0  # the end is seen before it begins again
        gaps_s = [*(after - before for before, after in pairwise(self._times_s)), last_s]
        animation.durations = [round(1000 * gap_s) for gap_s in gaps_s]
        options = [cv2.IMWRITE_WEBP_QUALITY, ANIMATION_QUALITY]
        try:
            written = cv2.imwriteanimation(self._name, animation, options)
        except cv2.error as error:
            raise CaptureError(f"{self._out}: OpenCV cannot write an animation here: {error.err}") from error
        if not written or (reason := why_not_more(self._out)):
            raise CaptureError(f"{self._out}: the animation could not be written: {reason if written else 'no room'}")
        return len(self._pictures)


class _Film:
    def __init__(self, out: Path, name: str, complaints: Complaints, size_px: tuple[int, int], start_s: float) -> None:
        self._out = out
        self._name = name
        self._complaints = complaints
        self._size = size_px
        self._start_s = start_s
        self._count = 0
        self._picture: ImageArray | None = None
        with complaints:
            self._writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*CODEC), RATE_HZ, self._size)
        if not self._writer.isOpened():
            raise CaptureError(f"{out}: OpenCV cannot write a film there; choose another place")
        complaints.are_new()  # messages of opening are not errors: it is open

    def show(self, at_s: float, picture: ImageArray) -> None:
        self._hold_until(at_s)
        if (picture.shape[1], picture.shape[0]) != self._size:
            picture = cv2.resize(picture, self._size).astype(picture.dtype)
        self._picture = picture

    def close(self) -> int:
        if self._picture is not None:
            self._write(self._picture)
        with self._complaints:
            self._writer.release()
            whole = self._is_whole()
        if not whole:
            raise self._broken(why_not_more(self._out) or "it cannot be opened")
        return self._count

    def _is_whole(self) -> bool:
        """Whether the film can be opened and has all its pictures."""
        film = cv2.VideoCapture(self._name)
        try:
            return film.isOpened() and round(film.get(cv2.CAP_PROP_FRAME_COUNT)) == self._count
        finally:
            film.release()

    def _hold_until(self, at_s: float) -> None:
        while self._picture is not None and self._start_s + (self._count + 0.5) / RATE_HZ < at_s:
            self._write(self._picture)

    def _write(self, picture: ImageArray) -> None:
        with self._complaints:
            self._writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        self._count += 1
        if self._complaints.are_new() and (reason := why_not_more(self._out)):
            with self._complaints:
                self._writer.release()
            raise self._broken(reason)

    def _broken(self, reason: str) -> CaptureError:
        return CaptureError(
            f"{self._out}: the film could not be written to its end: {reason}; make room there, or choose another place"
        )


def _caption(story: Story, log_ns: int, at_s: float) -> str:
    """Time, phase, distance to go, and the reason of the current behaviour."""
    words = [f"{at_s:5.1f} s"]
    task, plan = story.tasks.at(log_ns), story.plans.at(log_ns)
    if task is not None and task.task_id:
        words.append(f"{task.task} {task.label}: {task.outcome or task.phase}".strip())
    if plan is not None:
        if plan.distance_m is not None:
            words.append(f"{plan.distance_m:.2f} m")
        if plan.why:
            words.append(plan.why)
    return "  ".join(words)


AHEAD_BYTES = 64 * 1024
"""More than FFmpeg buffers before it writes, so that a failed write would not fit."""


@contextmanager
def spelt_for_opencv(path: Path) -> Iterator[str]:
    """Yields the path as OpenCV accepts it. OpenCV requires UTF-8 whatever the locale is, and crashes otherwise, so
    another name is replaced by a link that exists meanwhile. Raises CaptureError when no such link is possible."""
    try:
        name = os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        pass
    else:
        yield name
        return
    try:
        with tempfile.TemporaryDirectory() as folder:
            link = os.fsencode(folder).decode("utf-8") + "/film" + path.suffix
            Path(link).symlink_to(path.absolute())
            yield link
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path}: a name in UTF-8 is needed for it, or for TMPDIR") from error


class Complaints:
    """Catches OpenCV's output on standard error while it is entered: only there does OpenCV report a failed write."""

    def __init__(self) -> None:
        self._paper = os.memfd_create("complaints")
        self._stderr: int | None = None
        self._read_bytes = 0

    def __enter__(self) -> Complaints:
        try:
            self._stderr = os.dup(2)
        except OSError:  # no standard error: OpenCV prints nothing
            return self
        os.dup2(self._paper, 2)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stderr is not None:
            os.dup2(self._stderr, 2)
            os.close(self._stderr)
            self._stderr = None

    def are_new(self) -> bool:
        """Whether anything was printed since the last call."""
        before, self._read_bytes = self._read_bytes, os.fstat(self._paper).st_size
        return self._read_bytes > before

    def close(self) -> None:
        os.close(self._paper)


def why_not_more(path: Path) -> str:
    """The reason, in the system's words, for which a file cannot grow; '' when it can."""
    try:
        with tempfile.TemporaryFile(dir=path.parent, buffering=0) as probe:
            probe.seek(path.stat().st_size)
            left = AHEAD_BYTES
            while left:
                left -= probe.write(bytes(left))
    except OSError as error:
        return error.strerror or str(error)
    return ""
