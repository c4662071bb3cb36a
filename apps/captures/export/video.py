"""`--video`: what the robot saw, with what it made of it drawn in, as the paper's films have it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2

from apps.captures.export.opencv_file import Complaints, spelt_for_opencv, why_not_more
from apps.captures.export.outfile import making
from apps.captures.export.story import Story, catalogue_of, read
from cocoro.arrays import ImageArray
from cocoro.capture.errors import CaptureError
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.messages import Frame
from cocoro.picture import draw
from cocoro.topics import FRAME

RATE_HZ = 30.0
CODEC, SUFFIX = "mp4v", ".mp4"
"""MPEG-4 part 2: what OpenCV can write wherever it is installed."""


def export(capture: Capture, out: Path, progress: Callable[[float], None] = lambda _: None) -> int:
    """Write the film; the number of its pictures. In real time: a frame stays until the next, and what came faster
    than the film is left out. Raises CaptureError when there is nothing to show, or it cannot be written."""
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
        complaints.are_new()  # of opening it: it is open

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
        """A film whose end is missing cannot be opened."""
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
    """Time, phase, what is left to go, and why it does what it does."""
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
