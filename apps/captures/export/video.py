"""`--video`: the camera's pictures with detections and a caption drawn in."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import TracebackType

import cv2

from apps.captures.export.files import making
from apps.captures.export.story import Story, catalogue_of, read
from apps.captures.reader import Capture
from apps.pictures import draw
from cocoro.arrays import ImageArray
from cocoro.capture.conventions import CaptureError
from cocoro.clock import NS
from cocoro.messages import Frame
from cocoro.topics import FRAME

RATE_HZ = 30.0
CODEC, SUFFIX = "mp4v", ".mp4"
"""MPEG-4 part 2, which OpenCV can write on every platform."""


def export(capture: Capture, out: Path, progress: Callable[[float], None] = lambda _: None) -> int:
    """Write the film in real time: each frame is shown until the next one, and frames beyond the film's rate are left
    out.

    Returns the number of pictures. Raises CaptureError when the capture has no pictures or the film cannot be
    written.
    """
    if out.suffix.lower() != SUFFIX:
        raise CaptureError(f"{out}: a film's name ends with {SUFFIX}")
    with making(out):
        return _export(capture, out, progress)


def _export(capture: Capture, out: Path, progress: Callable[[float], None]) -> int:
    story, catalogue = Story(capture), catalogue_of(capture)
    film: _Film | None = None
    with spelt_for_opencv(out) as name, closing(Complaints()) as complaints:
        for record, frame in read(capture, FRAME):
            at_s = (record.log_ns - capture.start_ns) / NS
            if film is None:
                film = _Film(out, name, complaints, frame, at_s)
            seen = story.seen_in(frame.incarnation, frame.seq)
            film.show(at_s, draw(frame, seen, catalogue, _caption(story, record.log_ns, at_s)))
            progress(at_s)
        if film is None:
            raise CaptureError(f"{capture.path}: it has no pictures")
        return film.close()


class _Film:
    def __init__(self, out: Path, name: str, complaints: Complaints, first: Frame, start_s: float) -> None:
        self._out = out
        self._name = name
        self._complaints = complaints
        self._size = first.width, first.height
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
    """Why a file cannot grow, in the system's words; '' when it can."""
    try:
        with tempfile.TemporaryFile(dir=path.parent, buffering=0) as probe:
            probe.seek(path.stat().st_size)
            left = AHEAD_BYTES
            while left:
                left -= probe.write(bytes(left))
    except OSError as error:
        return error.strerror or str(error)
    return ""
