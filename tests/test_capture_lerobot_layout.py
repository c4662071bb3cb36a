"""The files of a LeRobotDataset that captures become, against the published layout v3.0."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lerobot_rig
import numpy as np
import pytest
from capture_rig import ROBOT
from lerobot_rig import GOLDEN, SPEED, WHOLE, Told, episode_of, recorded

from apps.captures.export.lerobot_episodes import Recording, recorded_tasks
from apps.captures.export.lerobot_stats import QUANTILES
from apps.cli.main import main
from cocoro.arrays import ImageArray
from cocoro.capture.tables import Tables
from cocoro.features import BASE_NAMES, names_of


@pytest.fixture(scope="module")
def libraries() -> tuple[Any, Any]:
    return lerobot_rig.libraries()


@pytest.fixture(scope="module")
def fetched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("recorded") / "fetch.mcap", WHOLE)


@pytest.fixture(scope="module")
def dataset(libraries: object, fetched: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a capture with a task that is done, and one with a task that is done and one that failed."""
    place = tmp_path_factory.mktemp("dataset")
    captures = place / "captures"
    captures.mkdir()
    (captures / "1.mcap").symlink_to(fetched)
    recorded(captures / "2.mcap", Told("blue_can", 5, 50, "failed"), Told("red_can", 60, 110))
    assert main(["export", str(captures), "--lerobot", str(place / "set")]) == 0
    return place / "set"


ROWS = (21, 10, 11)


def test_the_files_of_the_layout_are_there_and_no_others(dataset: Path) -> None:
    assert {str(path.relative_to(dataset)) for path in dataset.rglob("*") if path.is_file()} == {
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
        "videos/observation.images.kinect/chunk-000/file-000.mp4",
    }


def test_info_describes_the_dataset(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["robot_type"], info["fps"]) == ("v3.0", "calliope", 10)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, sum(ROWS), 2)
    assert info["splits"] == {"train": "0:3"}
    data = info["data_path"].format(chunk_index=0, file_index=0)
    film = info["video_path"].format(video_key="observation.images.kinect", chunk_index=0, file_index=0)
    assert (dataset / data).is_file()
    assert (dataset / film).is_file()
    features = info["features"]
    for name in ("observation.state", "action"):
        assert features[name] == {"dtype": "float32", "shape": [SPEED + 2], "names": names_of(ROBOT)}
    assert names_of(ROBOT)[-2:] == [*BASE_NAMES]
    pictures = features["observation.images.kinect"]
    assert (pictures["dtype"], pictures["shape"]) == ("video", [12, 16, 3])
    assert pictures["names"] == ["height", "width", "channels"]
    for name, kind in {
        "timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64",
        "task_index": "int64", "next.done": "bool", "next.success": "bool",
    }.items():  # fmt: skip
        assert features[name] == {"dtype": kind, "shape": [1], "names": None}


def test_rows_have_the_types_that_info_promises(dataset: Path, libraries: Any) -> None:
    table = libraries[0].read_table(dataset / "data/chunk-000/file-000.parquet")
    features = json.loads((dataset / "meta/info.json").read_text())["features"]
    del features["observation.images.kinect"]
    assert table.column_names == [*features]
    kinds = {"float32": "float", "int64": "int64", "bool": "bool"}
    for name, feature in features.items():
        kind, length = kinds[feature["dtype"]], feature["shape"][0]
        wanted = kind if feature["shape"] == [1] else f"fixed_size_list<element: {kind}>[{length}]"
        assert str(table.schema.field(name).type) == wanted


def test_rows_are_counted_through_episodes_and_dataset(dataset: Path, libraries: Any) -> None:
    rows = libraries[0].read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    assert rows["index"] == [*range(sum(ROWS))]
    assert rows["episode_index"] == [n for n, count in enumerate(ROWS) for _ in range(count)]
    assert rows["frame_index"] == [row for count in ROWS for row in range(count)]
    assert rows["timestamp"] == pytest.approx([row / 10 for row in rows["frame_index"]])
    assert rows["task_index"] == [n for n, count in zip((0, 1, 0), ROWS, strict=True) for _ in range(count)]
    ends = [sum(ROWS[: n + 1]) - 1 for n in range(3)]
    assert [n for n, done in enumerate(rows["next.done"]) if done] == ends
    assert [n for n, success in enumerate(rows["next.success"]) if success] == [ends[0], ends[2]]


def test_the_rows_of_an_episode_are_a_group_of_their_own(dataset: Path, libraries: Any) -> None:
    file = libraries[0].ParquetFile(dataset / "data/chunk-000/file-000.parquet")
    assert [file.read_row_group(n).num_rows for n in range(file.num_row_groups)] == [*ROWS]


def test_states_and_actions_are_those_of_the_capture(dataset: Path, libraries: Any, fetched: Path) -> None:
    rows = libraries[0].read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    episode = episode_of(fetched)
    assert np.array_equal(np.array(rows["observation.state"][: episode.rows], np.float32), episode.state)
    assert np.array_equal(np.array(rows["action"][: episode.rows], np.float32), episode.action)


def test_tasks_are_texts_that_pandas_takes_as_its_index(dataset: Path, libraries: Any) -> None:
    table = libraries[0].read_table(dataset / "meta/tasks.parquet")
    assert table.to_pydict() == {"task_index": [0, 1], "task": ["fetch red_can", "fetch blue_can"]}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_episodes_say_where_their_rows_and_pictures_are(dataset: Path, libraries: Any) -> None:
    episodes = libraries[0].read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["episode_index"] == [0, 1, 2]
    assert episodes["length"] == [*ROWS]
    assert episodes["tasks"] == [["fetch red_can"], ["fetch blue_can"], ["fetch red_can"]]
    assert episodes["dataset_from_index"] == [0, 21, 31]
    assert episodes["dataset_to_index"] == [21, 31, 42]
    film = "videos/observation.images.kinect"
    assert episodes[f"{film}/from_timestamp"] == pytest.approx([0.0, 2.1, 3.1])
    assert episodes[f"{film}/to_timestamp"] == pytest.approx([2.1, 3.1, 4.2])
    for kind in ("data", film, "meta/episodes"):
        assert episodes[f"{kind}/chunk_index"] == episodes[f"{kind}/file_index"] == [0, 0, 0]
    assert episodes["outcome"] == ["done", "failed", "done"]
    assert episodes["success"] == [True, False, True]
    assert episodes["capture"] == ["1.mcap", "2.mcap", "2.mcap"]


def test_statistics_are_those_of_all_rows_and_of_each_episode(dataset: Path, libraries: Any) -> None:
    rows = libraries[0].read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    episodes = libraries[0].read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    stats = json.loads((dataset / "meta/stats.json").read_text())
    assert {*stats} == {*json.loads((dataset / "meta/info.json").read_text())["features"]}
    state = np.array(rows["observation.state"])
    assert stats["observation.state"]["mean"] == pytest.approx(state.mean(axis=0).tolist())
    assert episodes["stats/observation.state/max"][1] == pytest.approx(state[21:31].max(axis=0).tolist())
    for name, of_one in stats.items():
        assert {*of_one} == {"min", "max", "mean", "std", "count", *QUANTILES}
        assert {f"stats/{name}/{each}" for each in of_one} <= {*episodes}
    assert stats["observation.images.kinect"]["count"] == [sum(ROWS)]


def decoded(libraries: Any, film: Path) -> Iterator[tuple[float, ImageArray]]:
    with libraries[1].open(str(film)) as container:
        for shown in container.decode(video=0):
            yield shown.time, shown.to_ndarray(format="rgb24")


def test_the_film_has_each_rows_picture_at_its_time(libraries: Any, tmp_path: Path) -> None:
    assert main(["export", str(GOLDEN), "--lerobot", str(tmp_path / "set")]) == 0
    film = [*decoded(libraries, tmp_path / "set/videos/observation.images.kinect/chunk-000/file-000.mp4")]
    with Tables.open(GOLDEN) as capture:
        recording = Recording(capture, ROBOT)
        pictures = [*recording.pictures(recording.episode(recorded_tasks(capture)[0], 10))]
    assert [time_s for time_s, _ in film] == pytest.approx([n / 10 for n in range(len(pictures))])
    for (_, shown), picture in zip(film, pictures, strict=True):
        assert np.abs(shown.astype(int) - picture.astype(int)).mean() < 4


def test_a_first_task_whose_pictures_all_wait_in_the_encoder_is_an_episode(libraries: Any, tmp_path: Path) -> None:
    recorded(tmp_path / "short.mcap", Told("blue_can", 5, 15), Told("red_can", 30, 45))
    assert main(["export", str(tmp_path / "short.mcap"), "--lerobot", str(tmp_path / "set")]) == 0
    film = [*decoded(libraries, tmp_path / "set/videos/observation.images.kinect/chunk-000/file-000.mp4")]
    assert len(film) == json.loads((tmp_path / "set/meta/info.json").read_text())["total_frames"] > 4


def test_lerobots_loader_reads_the_dataset(dataset: Path, fetched: Path) -> None:
    loader = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot is not installed")
    loaded = loader.LeRobotDataset("cocoro/test", root=dataset, video_backend="pyav")
    assert (loaded.num_episodes, len(loaded)) == (3, sum(ROWS))
    episode = episode_of(fetched)
    for row in (0, 10, 20):
        item = loaded[row]
        assert item["task"] == "fetch red_can"
        assert np.array_equal(item["observation.state"].numpy(), episode.state[row])
        assert np.array_equal(item["action"].numpy(), episode.action[row])
        assert item["observation.images.kinect"].shape == (3, 12, 16)
    assert loaded[25]["task"] == "fetch blue_can"
