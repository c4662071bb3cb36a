"""`--lerobot`: captures as a LeRobotDataset, one episode for each task."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from apps.captures.export.files import refuse_existing
from apps.captures.export.lerobot_episodes import (
    NotAnEpisodeError,
    RecordedTask,
    Recording,
    camera_rate_hz,
    recorded_tasks,
)
from apps.captures.export.lerobot_files import Dataset, Shape, libraries
from apps.captures.export.story import robot_of
from cocoro.capture.conventions import CaptureError
from cocoro.capture.tables import Tables
from cocoro.features import names_of
from cocoro.robot import Robot


class Exported(NamedTuple):
    episodes: int
    succeeded: int
    rows: int
    seconds: float
    """Of all episodes together."""
    left_out: tuple[str, ...]
    """Captures and tasks without an episode, each with the reason, and what else is not in the dataset."""
    problems: tuple[str, ...]
    """Unreadable parts of the captures."""


def files_of(places: Sequence[Path]) -> list[Path]:
    """The captures: files as they are, and those within folders by name. Raises CaptureError for a folder without."""
    found = []
    for place in places:
        inside = sorted(place.glob("*.mcap")) if place.is_dir() else [place]
        if not inside:
            raise CaptureError(f"{place}: no captures are in this folder")
        found += inside
    return found


def export(
    places: Sequence[Path],
    out: Path,
    rate_hz: int | None = None,
    progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> Exported:
    """Write the tasks of captures, and of those in folders, as a dataset into a new folder, at `rate_hz`, or else at
    the rate of the first capture's camera. `progress` gets the number of captures so far, and of all.

    Raises CaptureError when no task makes an episode, when a library is missing, and when the folder exists or cannot
    be written; nothing is left of the folder then.
    """
    refuse_existing(out)
    _, av = libraries()
    paths = files_of(places)
    try:
        with _making(out) as folder:
            made = _Export(folder, rate_hz)
            for number, path in enumerate(paths):
                made.add(path)
                progress(number + 1, len(paths))
            return made.finish()
    except (OSError, av.FFmpegError) as error:
        raise CaptureError(f"{out}: {error.strerror or error}") from error


class _Export:
    def __init__(self, folder: Path, rate_hz: int | None) -> None:
        self._folder = folder
        self._rate_hz = rate_hz
        self._dataset: Dataset | None = None
        self._succeeded = 0
        self._left_out: list[str] = []
        self._problems: list[str] = []

    def add(self, path: Path) -> None:
        """Add the tasks of one capture."""
        with Tables.open(path) as capture:
            try:
                tasks = recorded_tasks(capture)
                if not tasks:
                    raise NotAnEpisodeError("it has no task")
                robot = robot_of(capture.capture)
                recording = Recording(capture, robot)
                self._rate_hz = self._rate_hz or camera_rate_hz(capture)
            except NotAnEpisodeError as reason:
                self._left_out.append(f"{path}: {reason}")
            else:
                for task in tasks:
                    try:
                        self._add(recording, task, robot, path)
                    except NotAnEpisodeError as reason:
                        self._left_out.append(f"{path}: {task.text}: {reason}")
            self._problems += [f"{path}: {problem}" for problem in capture.problems]

    def _add(self, recording: Recording, task: RecordedTask, robot: Robot, path: Path) -> None:
        assert self._rate_hz is not None
        episode = recording.episode(task, self._rate_hz)
        pictures = recording.pictures(episode)
        first = next(pictures)
        height, width = first.shape[:2]
        shape = Shape(robot.name, tuple(names_of(robot)), self._rate_hz, width, height)
        if self._dataset is None:
            self._dataset = Dataset(self._folder, shape)
        if (reason := _differs(shape, self._dataset.shape)) is not None:
            raise NotAnEpisodeError(reason)
        self._dataset.add(episode, chain([first], pictures))
        self._succeeded += task.outcome == "done"
        if not task.outcome:
            self._left_out.append(f"{path}: {task.text}: it has no outcome there, which counts as no success")

    def finish(self) -> Exported:
        """Write what describes the dataset. Raises CaptureError when it has no episode."""
        if self._dataset is None:
            raise CaptureError(f"no task makes an episode: {'; '.join(self._left_out)}")
        self._dataset.close()
        self._left_out.append("depth: the dataset has the colour pictures alone")
        made = self._dataset
        return Exported(
            episodes=made.episodes,
            succeeded=self._succeeded,
            rows=made.rows,
            seconds=made.rows / made.shape.rate_hz,
            left_out=tuple(self._left_out),
            problems=tuple(self._problems),
        )


def _differs(shape: Shape, of_all: Shape) -> str | None:
    """Why an episode does not fit the others; None when it does."""
    if (shape.robot, shape.names) != (of_all.robot, of_all.names):
        return f"its robot is {shape.robot} with {len(shape.names)} values, the dataset's is {of_all.robot} with others"
    if (shape.width, shape.height) != (of_all.width, of_all.height):
        return (
            f"its pictures have {shape.width} x {shape.height} pixels, those of the dataset "
            f"{of_all.width} x {of_all.height}"
        )
    return None


@contextmanager
def _making(out: Path) -> Iterator[Path]:
    """Context for making a folder: yields another one beside it, which gets its name at the end. After an error nothing
    is left of it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        folder.chmod(0o755)
        yield folder
        folder.rename(out)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
