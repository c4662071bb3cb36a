"""The files of a LeRobotDataset v3.0: rows and episodes as Parquet, pictures as films, and what describes them.

The layout is that of `lerobot` 0.4 to 0.6 (its `datasets` package): `meta/info.json`, `meta/stats.json`,
`meta/tasks.parquet`, and numbered files in `meta/episodes/`, `data/` and `videos/`. A file has many episodes; each of
them is within one file of each kind.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apps.captures.export.lerobot_episodes import Episode
from apps.captures.export.lerobot_stats import SAMPLED_PICTURES, PictureStats, Stats, of_values
from cocoro.arrays import ImageArray
from cocoro.capture.conventions import CaptureError
from cocoro.features import ACTION, PICTURES, STATE

VERSION = "v3.0"
DONE, SUCCESS = "next.done", "next.success"
COUNTED = ("frame_index", "episode_index", "index", "task_index")
FILES_IN_CHUNK = 1000
DATA_MB, VIDEO_MB = 100, 200
"""A file that has reached this size gets no further episode."""
NUMBERED = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH, EPISODES_PATH = f"data/{NUMBERED}.parquet", f"meta/episodes/{NUMBERED}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{NUMBERED}.mp4"
ENCODER, CODEC, PIXELS = "libx264", "h264", "yuv420p"
ENCODING = {"preset": "veryfast", "crf": "23", "g": "2", "bf": "0"}
"""Every second picture can be decoded by itself, as readers ask for single ones."""


class Shape(NamedTuple):
    """What all episodes of a dataset have in common."""

    robot: str
    names: tuple[str, ...]
    """Of the values of state and action."""
    rate_hz: int
    width: int
    height: int


class Dataset:
    """Writes a dataset into an empty folder: `add` for each episode, then `close`."""

    def __init__(self, folder: Path, shape: Shape) -> None:
        """Raises CaptureError when pyarrow or PyAV are not installed, or the pictures have no size for a film."""
        self._arrow, self._av = libraries()
        if shape.width % 2 or shape.height % 2:
            raise CaptureError(
                f"pictures of {shape.width} x {shape.height} make no film of {CODEC}: both sides must be even"
            )
        self.shape = shape
        self.rows = 0
        self._folder = folder
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._columns: dict[str, list[Any]] = {}
        """Of each numeric feature the columns of all episodes."""
        self._seen = PictureStats()
        self._data: _NumberedFile | None = None
        self._film: _NumberedFile | None = None

    @property
    def episodes(self) -> int:
        return len(self._episodes)

    def add(self, episode: Episode, pictures: Iterable[ImageArray]) -> None:
        """Add an episode with its pictures. An error of `pictures` before the first one leaves the dataset as it was;
        after any other the dataset is broken. Raises CaptureError when pictures differ in size, OSError without room.
        """
        filmed = self._write_pictures(pictures, episode.rows)
        number, task = self.episodes, self._tasks.setdefault(episode.task.text, len(self._tasks))
        last = np.arange(episode.rows) == episode.rows - 1
        columns = {
            STATE: episode.state,
            ACTION: episode.action,
            DONE: last,
            SUCCESS: last & (episode.task.outcome == "done"),
            "timestamp": (np.arange(episode.rows) / self.shape.rate_hz).astype(np.float32),
            "frame_index": np.arange(episode.rows),
            "episode_index": np.full(episode.rows, number),
            "index": np.arange(self.rows, self.rows + episode.rows),
            "task_index": np.full(episode.rows, task),
        }
        row = {
            "episode_index": number,
            "tasks": [episode.task.text],
            "length": episode.rows,
            "dataset_from_index": self.rows,
            "dataset_to_index": self.rows + episode.rows,
            "success": episode.task.outcome == "done",
            "outcome": episode.task.outcome,
            "reason": episode.task.reason,
            "task_id": episode.task.task_id,
            "capture": episode.capture,
        }
        row |= filmed | self._write_rows(columns)
        for name, column in columns.items():
            self._columns.setdefault(name, []).append(column)
            row |= _flat(name, of_values(column))
        self._episodes.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        self.rows += episode.rows

    def close(self) -> None:
        """Finish all files."""
        for file in (self._data, self._film):
            if file is not None:
                file.close()
        meta = self._folder / "meta"
        episodes = self._folder / EPISODES_PATH.format(chunk_index=0, file_index=0)
        episodes.parent.mkdir(parents=True)
        self._arrow.parquet.write_table(self._arrow.Table.from_pylist(self._episodes), episodes)
        self._arrow.parquet.write_table(self._task_table(), meta / "tasks.parquet")
        stats = {name: of_values(np.concatenate(columns)) for name, columns in self._columns.items()}
        _write_json(meta / "stats.json", stats | {PICTURES: self._seen.stats()})
        _write_json(meta / "info.json", self._info())

    # --- data -------------------------------------------------------------------------------------

    def _write_rows(self, columns: dict[str, Any]) -> dict[str, int]:
        arrow = self._arrow
        arrays = {
            name: arrow.FixedSizeListArray.from_arrays(arrow.array(column.ravel()), column.shape[1])
            if column.ndim == 2
            else arrow.array(column)
            for name, column in columns.items()
        }
        table = arrow.table(arrays)
        if self._data is None or self._data.is_full(DATA_MB):
            self._data = _NumberedFile(self._folder, DATA_PATH, self._data)
            self._data.writer = arrow.parquet.ParquetWriter(self._data.path, table.schema)
        self._data.writer.write_table(table)  # an episode is one group of rows, which can be read by itself
        return {"data/chunk_index": self._data.chunk, "data/file_index": self._data.number}

    def _task_table(self) -> Any:
        """The tasks; pandas, with which readers read them, gets the texts as its index."""
        arrow = self._arrow
        table = arrow.table({"task_index": [*self._tasks.values()], "task": [*self._tasks]})
        kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
        about = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [
                {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
                for name, (kind, numpy_kind) in kinds.items()
            ],
            "creator": {"library": "pyarrow", "version": arrow.__version__},
            "pandas_version": "2.0.0",
        }
        return table.replace_schema_metadata({"pandas": json.dumps(about)})

    # --- films ------------------------------------------------------------------------------------

    def _write_pictures(self, pictures: Iterable[ImageArray], rows: int) -> dict[str, Any]:
        each = iter(pictures)
        pictures = chain([next(each)], each)  # an error of the first one before a file is made for it
        if self._film is None or self._film.is_full(VIDEO_MB):
            self._film = _NumberedFile(self._folder, VIDEO_PATH.replace("{video_key}", PICTURES), self._film)
            self._film.writer = _Film(self._av, self._film.path, self.shape)
        film: _Film = self._film.writer
        first, stats = film.pictures, PictureStats()
        for row, picture in enumerate(pictures):
            film.show(picture)
            if row % max(1, rows // SAMPLED_PICTURES) == 0:
                stats.see(picture)
        self._seen.add(stats)
        found = {
            "chunk_index": self._film.chunk,
            "file_index": self._film.number,
            "from_timestamp": first / self.shape.rate_hz,
            "to_timestamp": film.pictures / self.shape.rate_hz,
        }
        return {f"videos/{PICTURES}/{name}": value for name, value in found.items()} | _flat(PICTURES, stats.stats())

    # --- what describes it ------------------------------------------------------------------------

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self.shape.robot,
            "total_episodes": self.episodes,
            "total_frames": self.rows,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self.shape.rate_hz,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": self._features(),
        }

    def _features(self) -> dict[str, Any]:
        names, shape = [*self.shape.names], self.shape
        values = {"dtype": "float32", "shape": [len(names)], "names": names}
        film = {
            "video.height": shape.height, "video.width": shape.width, "video.channels": 3, "video.codec": CODEC,
            "video.pix_fmt": PIXELS, "video.fps": shape.rate_hz, "is_depth_map": False, "has_audio": False,
        }  # fmt: skip
        pictures = {
            "dtype": "video",
            "shape": [shape.height, shape.width, 3],
            "names": ["height", "width", "channels"],
            "info": film,
        }
        single = {
            DONE: "bool",
            SUCCESS: "bool",
            "timestamp": "float32",
            **dict.fromkeys(COUNTED, "int64"),
        }
        return {STATE: values, ACTION: dict(values), PICTURES: pictures} | {
            name: {"dtype": kind, "shape": [1], "names": None} for name, kind in single.items()
        }


class _NumberedFile:
    """One of the numbered files, and who writes it."""

    def __init__(self, folder: Path, pattern: str, former: _NumberedFile | None) -> None:
        """The file after `former`, which is closed."""
        self.chunk: int
        self.number: int
        after = 0
        if former is not None:
            former.close()
            after = former.chunk * FILES_IN_CHUNK + former.number + 1
        self.chunk, self.number = divmod(after, FILES_IN_CHUNK)
        self.path = folder / pattern.format(chunk_index=self.chunk, file_index=self.number)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.writer: Any = None

    def is_full(self, most_mb: int) -> bool:
        """There is no film yet while its first pictures wait in the encoder."""
        return self.path.is_file() and self.path.stat().st_size >= most_mb * 1_000_000

    def close(self) -> None:
        self.writer.close()


class _Film:
    """The pictures of many episodes, one after another at the dataset's rate."""

    def __init__(self, av: Any, path: Path, shape: Shape) -> None:
        self.pictures = 0
        self._av = av
        self._size = shape.height, shape.width, 3
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream(ENCODER, rate=shape.rate_hz, options=ENCODING)
        self._stream.width, self._stream.height, self._stream.pix_fmt = shape.width, shape.height, PIXELS
        self._stream.codec_context.time_base = Fraction(1, shape.rate_hz)

    def show(self, picture: ImageArray) -> None:
        if picture.shape != self._size:
            raise CaptureError(
                f"a picture has {picture.shape[1]} x {picture.shape[0]} pixels, others have another size"
            )
        frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = self.pictures, self._stream.codec_context.time_base
        self._container.mux(self._stream.encode(frame))
        self.pictures += 1

    def close(self) -> None:
        self._container.mux(self._stream.encode(None))
        self._container.close()


def libraries() -> tuple[Any, Any]:
    """pyarrow, with `pyarrow.parquet`, and PyAV. Raises CaptureError when one is not installed."""
    try:
        import av
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        raise CaptureError(f"--lerobot needs {error.name}: pip install 'cocoro-mesh[lerobot]'") from error
    return pyarrow, av


def _flat(feature: str, stats: Stats) -> dict[str, Any]:
    return {f"stats/{feature}/{name}": value for name, value in stats.items()}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
