"""The tasks of a capture as episodes: rows at a fixed rate, each with state, action and picture.

Rows are equally spaced from the first picture of a task on. A row's picture is the nearest in time; state and action
are held: the newest whose stamp is not later than the row's time. All times are stamps, not times of recording.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray, IntArray, median
from cocoro.capture.columns import Columns, MissingColumnError
from cocoro.capture.conventions import CaptureError
from cocoro.capture.tables import Tables
from cocoro.clock import NS
from cocoro.features import JOINT_STATES, picture_of, rows_of
from cocoro.robot import Robot
from cocoro.topics import (
    ARM_COMMAND,
    BASE_COMMAND,
    BASE_STATE,
    FRAME,
    HAND_COMMAND,
    TASK,
)

COMMANDS = (ARM_COMMAND, HAND_COMMAND)
LONGEST_GAP_NS = round(FRAME.max_age_s * NS)
"""A task whose pictures or states have a longer gap is no episode: nothing in the robot acts on an older picture."""


class NotAnEpisodeError(CaptureError):
    """A task, or a capture, has no episode that fits the dataset. The text gives the reason alone."""


class RecordedTask(NamedTuple):
    """A task as the executive told of it."""

    task_id: str
    text: str
    """The task with its target: `fetch red_can`."""
    start_ns: int
    end_ns: int
    """Stamp of the first message with its outcome; without one, of the last message."""
    outcome: str
    """done, failed, cancelled; '' when the capture ends before the task."""
    reason: str


class Episode(NamedTuple):
    """A task as rows at a fixed rate."""

    task: RecordedTask
    capture: str
    """Name of the file."""
    pictures_ns: IntArray
    """Stamp of each row's picture, shape (rows,)."""
    state: Float32Array
    """Joint angles, rad, in the description's order, then the base's speeds by odometry, shape (rows, joints + 2), or
    + 3 for a base that can move aside."""
    action: Float32Array
    """Joint goals, rad, then the commanded speeds, in the same shape."""

    @property
    def rows(self) -> int:
        return len(self.pictures_ns)


def recorded_tasks(capture: Tables) -> list[RecordedTask]:
    """The tasks in the order of their beginnings."""
    found: dict[str, RecordedTask] = {}
    if TASK.name not in capture:
        return []
    told = capture[TASK.name]
    if not told.rows:
        return []
    fields = ("task_id", "task", "label", "started_ns", "stamp_ns", "outcome", "reason")
    for id, task, label, start_ns, stamp_ns, outcome, reason in zip(*(told[field] for field in fields), strict=True):
        if id and not (id in found and found[id].outcome):
            text = f"{task} {label}".strip()
            found[id] = RecordedTask(id, text, int(start_ns), int(stamp_ns), outcome or "", reason)
    return sorted(found.values(), key=lambda task: task.start_ns)


def camera_rate_hz(capture: Tables) -> int:
    """The rate at which a capture's pictures follow each other, at least 1 Hz. Raises NotAnEpisodeError without
    pictures."""
    stamps = _picture_stamps(capture)
    if len(stamps) < 2:
        raise NotAnEpisodeError("it has no pictures")
    return max(1, round(NS / median(np.diff(stamps).astype(np.float64))))


class Recording:
    """What a capture has for episodes: states, commands, and the stamps of pictures."""

    def __init__(self, capture: Tables, robot: Robot) -> None:
        """Raises NotAnEpisodeError when the robot's state or all pictures are missing."""
        wanted = [topic.name for topic in (*JOINT_STATES, *COMMANDS, BASE_STATE, BASE_COMMAND, TASK)]
        capture.load(*(name for name in wanted if name in capture))
        self._capture = capture
        self._pictures_ns = _picture_stamps(capture)
        if not len(self._pictures_ns):
            raise NotAnEpisodeError("it has no pictures")
        self._positions = _by_joint(capture, [topic.name for topic in JOINT_STATES], "position_rad")
        for joint in robot.joints:
            if joint not in self._positions:
                raise NotAnEpisodeError(f"it has no state of the joint {joint}")
        self._goals = _by_joint(capture, [topic.name for topic in COMMANDS], "goal_rad", "speed_radps")
        self._joints = [*robot.joints]
        aside = ["aside_mps"] if robot.drive.goes_aside else []
        self._odometry = _series(capture, BASE_STATE.name, "speed_mps", *aside, "turn_rate_radps")
        if not len(self._odometry.stamps_ns):
            raise NotAnEpisodeError("it has no state of the base")
        self._commanded = _series(capture, BASE_COMMAND.name, "ahead_mps", *aside, "turn_radps")
        self._command_ns = round(robot.base.command_timeout_s * NS)

    def episode(self, task: RecordedTask, rate_hz: int) -> Episode:
        """A task's rows. Raises NotAnEpisodeError with the reason when pictures or states have a gap."""
        known_ns = max(series.stamps_ns[0] for series in self._states())
        start_ns = max(task.start_ns, known_ns)
        pictures = self._pictures_ns[(self._pictures_ns >= start_ns) & (self._pictures_ns <= task.end_ns)]
        if len(pictures) < 2:
            raise NotAnEpisodeError("the capture has no pictures of it")
        _refuse_gaps("pictures", [task.start_ns, *pictures.tolist(), task.end_ns], task)
        count = round((pictures[-1] - pictures[0]) * rate_hz / NS) + 1
        times = pictures[0] + np.round(np.arange(count) * (NS / rate_hz)).astype(np.int64)
        for series in self._states():
            inside = (series.stamps_ns > times[0]) & (series.stamps_ns < times[-1])
            _refuse_gaps("states", [times[0], *series.stamps_ns[inside].tolist(), times[-1]], task)
        state = self._state(times)
        chosen = pictures[_nearest(pictures, times)]
        return Episode(task, self._capture.path.name, chosen, state, self._action(times, state))

    def pictures(self, episode: Episode) -> Iterator[ImageArray]:
        """The picture of each row, RGB. A picture that cannot be read is replaced by the one before it. Raises
        NotAnEpisodeError when the first one cannot be read."""
        seen = self._capture[FRAME.name]
        first, last = (np.argmax(seen["stamp_ns"] == episode.pictures_ns[end]) for end in (0, -1))
        frames = self._capture.frames(
            start_s=float(seen["time_s"][first]) - 1e-6, end_s=float(seen["time_s"][last]) + 1e-6
        )
        row, held = 0, None
        for frame in frames:
            while row < episode.rows and episode.pictures_ns[row] < frame.stamp_ns:
                if held is None:
                    raise NotAnEpisodeError("its first picture cannot be read")
                yield held
                row += 1
            held = picture_of(frame)
        for _ in range(row, episode.rows):
            if held is None:
                raise NotAnEpisodeError("its pictures cannot be read")
            yield held

    def _states(self) -> list[_Series]:
        return [*(self._positions[joint] for joint in self._joints), self._odometry]

    def _state(self, times_ns: IntArray) -> Float32Array:
        angles = [self._positions[joint].held(times_ns) for joint in self._joints]
        return rows_of(angles, self._odometry.held(times_ns))

    def _action(self, times_ns: IntArray, state: Float32Array) -> Float32Array:
        """Goals in force. A joint without a goal, or whose command holds it, has its position as goal. The base's speed
        is zero where its last command is too old to count."""
        action = state.copy()
        for n, joint in enumerate(self._joints):
            if joint in self._goals:
                goal, speed = self._goals[joint].held(times_ns).T
                commanded = speed > 0  # not where it is NaN: before the first command
                action[commanded, n] = goal[commanded]
        action[:, len(self._joints) :] = np.nan_to_num(self._commanded.held(times_ns, self._command_ns))
        return action


class _Series(NamedTuple):
    """Values by stamp."""

    stamps_ns: IntArray
    """Ascending, shape (n,)."""
    values: FloatArray
    """Shape (n, values)."""

    def held(self, times_ns: IntArray, longest_ns: int | None = None) -> FloatArray:
        """The newest values at each time, shape (times, values); NaN before the first, and where they are older than
        `longest_ns`."""
        if not len(self.stamps_ns):
            return np.full((len(times_ns), self.values.shape[1]), np.nan)
        places = np.searchsorted(self.stamps_ns, times_ns, side="right") - 1
        found: FloatArray = self.values[np.maximum(places, 0)].astype(np.float64)
        found[places < 0] = np.nan
        if longest_ns is not None:
            found[times_ns - self.stamps_ns[np.maximum(places, 0)] > longest_ns] = np.nan
        return found


def _series(capture: Tables, topic: str, *fields: str) -> _Series:
    if topic not in capture or not capture[topic].rows:
        return _Series(np.empty(0, np.int64), np.empty((0, len(fields))))
    columns = capture[topic]
    return _sorted(columns["stamp_ns"], np.column_stack([columns[field] for field in fields]))


def _sorted(stamps_ns: IntArray, values: FloatArray) -> _Series:
    order = np.argsort(stamps_ns, kind="stable")
    return _Series(stamps_ns[order], values[order])


def _by_joint(capture: Tables, topics: Sequence[str], *fields: str) -> dict[str, _Series]:
    """The fields of each joint that any message of these topics names."""
    stamps: dict[str, list[IntArray]] = defaultdict(list)
    values: dict[str, list[FloatArray]] = defaultdict(list)
    for topic in topics:
        columns: Columns | None = capture.get(topic)
        if columns is None or not columns.rows:
            continue
        each = [tuple(joints) for joints in columns["joints"]]
        for joints in dict.fromkeys(each):
            rows = [row for row, named in enumerate(each) if named == joints]
            parts = [np.array([columns[field][row] for row in rows], np.float64) for field in fields]
            for place, joint in enumerate(joints):
                stamps[joint].append(columns["stamp_ns"][rows])
                values[joint].append(np.column_stack([part[:, place] for part in parts]))
    return {joint: _sorted(np.concatenate(stamps[joint]), np.concatenate(values[joint])) for joint in stamps}


def _picture_stamps(capture: Tables) -> IntArray:
    if FRAME.name not in capture:
        return np.empty(0, np.int64)
    seen = capture[FRAME.name]
    try:
        stamps: IntArray = np.unique(seen["stamp_ns"])
    except MissingColumnError:  # of a channel without messages
        return np.empty(0, np.int64)
    return stamps


def _nearest(stamps_ns: IntArray, times_ns: IntArray) -> IntArray:
    """For each time the place of the nearest of at least two ascending stamps."""
    after = np.clip(np.searchsorted(stamps_ns, times_ns), 1, len(stamps_ns) - 1)
    earlier = times_ns - stamps_ns[after - 1] <= stamps_ns[after] - times_ns
    nearest: IntArray = after - earlier
    return nearest


def _refuse_gaps(what: str, stamps_ns: Sequence[int], task: RecordedTask) -> None:
    for before, after in pairwise(stamps_ns):
        if after - before > LONGEST_GAP_NS:
            raise NotAnEpisodeError(
                f"its {what} have a gap of {(after - before) / NS:.1f} s, {(before - task.start_ns) / NS:.1f} s after "
                f"its begin"
            )
