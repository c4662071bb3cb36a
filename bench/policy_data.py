"""Reads a LeRobotDataset for training: rows of each episode that succeeded, with what a policy looks at."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.features import ACTION, PICTURES, STATE

Look = Callable[[Float32Array, ImageArray], FloatArray]


class Layout(NamedTuple):
    """What meta/info.json says of a dataset."""

    names: tuple[str, ...]
    """Of the values of state and action."""
    rate_hz: float
    width: int
    height: int
    robot: str


class Episode(NamedTuple):
    inputs: FloatArray
    """What a look makes of each row, shape (rows, inputs)."""
    actions: FloatArray
    """Shape (rows, values)."""


def layout_of(folder: Path) -> Layout:
    info = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
    features = info["features"]
    height, width, _ = features[PICTURES]["shape"]
    return Layout(tuple(features[STATE]["names"]), float(info["fps"]), width, height, str(info["robot_type"]))


def episodes_of(folder: Path, look: Look, task: str) -> list[Episode]:
    """The episodes of a dataset in which a task, as its text has it, succeeded."""
    import pyarrow.parquet as parquet

    tasks = parquet.read_table(folder / "meta/tasks.parquet").to_pydict()
    texts = dict(zip(tasks["task_index"], tasks[next(name for name in tasks if name != "task_index")], strict=True))
    pictures = _pictures(folder)
    found = []
    for path in sorted((folder / "data").glob("*/*.parquet")):
        rows = parquet.read_table(path).to_pydict()
        state, action = (np.array(rows[name], np.float32) for name in (STATE, ACTION))
        numbers = np.array(rows["episode_index"])
        for number in dict.fromkeys(numbers.tolist()):
            own = np.flatnonzero(numbers == number)
            inputs = np.array([look(state[row], next(pictures)) for row in own])
            if rows["next.success"][own[-1]] and texts[rows["task_index"][own[0]]] == task:
                found.append(Episode(inputs, action[own].astype(np.float64)))
    return found


def _pictures(folder: Path) -> Iterator[ImageArray]:
    """The pictures of all rows, in order."""
    import av

    for path in sorted((folder / "videos" / PICTURES).glob("*/*.mp4")):
        with av.open(str(path)) as film:
            for picture in film.decode(video=0):
                shown: Any = picture.to_ndarray(format="rgb24")
                yield shown
