"""Tasks of captures as episodes of a LeRobotDataset: what a row has, and what is left out or refused."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lerobot_rig
import numpy as np
import pytest
from capture_rig import ROBOT
from lerobot_rig import GOLDEN, JOINTS, SPEED, TURN, WHOLE, Told, angle, at, episode_of, recorded
from omni_robot import omni_robot

from apps.captures.export import lerobot
from apps.captures.export.lerobot_episodes import NotAnEpisodeError, Recording, camera_rate_hz, recorded_tasks
from apps.captures.export.lerobot_stats import QUANTILES, PictureStats, of_values
from apps.cli.main import main
from cocoro.capture.conventions import CaptureError
from cocoro.capture.tables import Tables
from cocoro.features import names_of
from cocoro.messages import Frame


@pytest.fixture(scope="module")
def libraries() -> tuple[Any, Any]:
    return lerobot_rig.libraries()


@pytest.fixture(scope="module")
def fetched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("recorded") / "fetch.mcap", WHOLE)


# --- episodes and rows ----------------------------------------------------------------------------


def test_each_task_of_a_capture_is_told_with_its_outcome(tmp_path: Path) -> None:
    tasks = Told("red_can", 10, 40), Told("blue_can", 50, 90, "failed"), Told("green_can", 100, 110, None)
    with Tables.open(recorded(tmp_path / "three.mcap", *tasks)) as capture:
        found = recorded_tasks(capture)
    assert [task.text for task in found] == ["fetch red_can", "fetch blue_can", "fetch green_can"]
    assert [task.outcome for task in found] == ["done", "failed", ""]
    assert [(task.start_ns, task.end_ns) for task in found] == [(at(task.first), at(task.last)) for task in tasks]


def test_rows_are_equally_spaced_and_have_the_nearest_picture(fetched: Path) -> None:
    assert episode_of(fetched).pictures_ns.tolist() == [at(tick) for tick in range(10, 111, 5)]
    every_second = episode_of(fetched, rate_hz=5).pictures_ns.tolist()
    assert every_second == [at(tick) for tick in range(10, 111, 10)]
    twice = episode_of(fetched, rate_hz=20)
    assert twice.rows == 41
    assert twice.pictures_ns[::2].tolist() == [at(tick) for tick in range(10, 111, 5)]


def test_a_rows_state_is_the_newest_that_is_not_later(fetched: Path) -> None:
    episode = episode_of(fetched)
    for row, tick in enumerate(range(10, 111, 5)):
        assert episode.state[row, :SPEED].tolist() == pytest.approx([angle(joint, tick) for joint in JOINTS])
        assert episode.state[row, SPEED] == pytest.approx(tick / 100)


def test_between_two_states_the_earlier_one_holds(fetched: Path) -> None:
    episode = episode_of(fetched, rate_hz=40)  # every second row is 25 ms after a picture, 5 ms after a state
    assert episode.state[1, SPEED] == pytest.approx(0.11)


def test_a_rows_action_is_the_goal_in_force(fetched: Path) -> None:
    action = episode_of(fetched).action
    pan = JOINTS.index("neck_pan")
    ticks = [*range(10, 111, 5)]
    goals = [0.5 if 30 <= tick < 80 else angle("neck_pan", tick) for tick in ticks]  # before, and while it is held
    assert action[:, pan].tolist() == pytest.approx(goals)
    others = [n for n in range(SPEED) if n != pan]
    assert np.array_equal(action[:, others], episode_of(fetched).state[:, others])  # none was commanded


def test_a_command_of_the_base_counts_as_long_as_it_obeys_it(fetched: Path) -> None:
    action = episode_of(fetched).action
    valid = 59 + int(ROBOT.base.command_timeout_s * 50)
    for row, tick in enumerate(range(10, 111, 5)):
        moves = 30 <= tick <= valid
        assert action[row, SPEED] == pytest.approx(0.15 if moves else 0.0)
        assert action[row, TURN] == pytest.approx(0.4 if moves else 0.0)


def test_a_base_that_can_move_aside_has_its_speed_aside_between_the_two_others(fetched: Path) -> None:
    robot = omni_robot()
    assert names_of(robot)[-3:] == ["x.vel", "y.vel", "theta.vel"]
    with Tables.open(fetched) as capture:
        episode = Recording(capture, robot).episode(recorded_tasks(capture)[0], 10)
    ticks = range(10, 111, 5)
    assert episode.state[:, SPEED:].tolist() == [pytest.approx([tick / 100, tick / 200, 0.0]) for tick in ticks]
    assert episode.action[ticks.index(50), SPEED:].tolist() == pytest.approx([0.15, 0.1, 0.4])
    assert names_of(ROBOT)[-2:] == ["x.vel", "theta.vel"]


def test_the_pictures_of_an_episode_are_those_of_its_rows(fetched: Path) -> None:
    episode = episode_of(fetched, rate_hz=20)
    with Tables.open(fetched) as capture:
        frames = {seen.stamp_ns: bytes(seen.colour) for seen in capture.frames()}
        shown = [picture.tobytes() for picture in Recording(capture, ROBOT).pictures(episode)]
    assert shown == [frames[stamp_ns] for stamp_ns in episode.pictures_ns.tolist()]


def test_the_default_rate_is_the_cameras(fetched: Path) -> None:
    for path, rate_hz in ((fetched, 10), (GOLDEN, 10)):
        with Tables.open(path) as capture:
            assert camera_rate_hz(capture) == rate_hz


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"blind": range(50, 90)}, r"pictures have a gap of 0\.9 s, 0\.7 s after"),
        ({"blind": range(80, 200)}, r"pictures have a gap of 0\.7 s"),
        ({"numb": range(50, 90)}, r"states have a gap of 0\.8 s"),
        ({"blind": range(10, 200)}, "no pictures of it"),
        ({"blind": range(200)}, "no pictures"),
        ({"numb": range(200)}, "no state of the joint neck_pan"),
    ],
)
def test_a_task_with_gaps_is_no_episode_and_the_reason_is_said(tmp_path: Path, how: Any, reason: str) -> None:
    path = recorded(tmp_path / "gaps.mcap", WHOLE, **how)
    with pytest.raises(NotAnEpisodeError, match=reason):
        episode_of(path)


def test_a_task_that_began_before_the_capture_is_no_episode(tmp_path: Path) -> None:
    path = recorded(tmp_path / "late.mcap", Told("red_can", -100, 110))
    with pytest.raises(NotAnEpisodeError, match=r"pictures have a gap of 2\.0 s, 0\.0 s after its begin"):
        episode_of(path)


# --- statistics -----------------------------------------------------------------------------------


def test_statistics_of_values_are_exact() -> None:
    values = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32)
    stats = of_values(values)
    assert stats["mean"] == pytest.approx(values.mean(axis=0, dtype=np.float64).tolist())
    assert stats["std"] == pytest.approx(values.std(axis=0, dtype=np.float64).tolist())
    assert (stats["min"], stats["max"]) == (values.min(axis=0).tolist(), values.max(axis=0).tolist())
    assert stats["q90"] == pytest.approx(np.quantile(values.astype(np.float64), 0.9, axis=0).tolist())
    assert stats["count"] == [500]
    assert of_values(np.array([False, False, False, True]))["mean"] == [0.25]


def test_statistics_of_pictures_are_those_of_their_pixels() -> None:
    made = np.random.default_rng(2).integers(3, 250, size=(4, 12, 16, 3), dtype=np.uint8)
    made[..., 2] //= 2
    halves = PictureStats(), PictureStats()
    for n, picture in enumerate(made):
        halves[n // 2].see(picture)
    halves[0].add(halves[1])
    stats, pixels = halves[0].stats(), made.reshape(-1, 3) / 255
    for name, wanted in {
        "min": pixels.min(axis=0), "max": pixels.max(axis=0), "mean": pixels.mean(axis=0), "std": pixels.std(axis=0),
    }.items():  # fmt: skip
        assert np.array(stats[name]).shape == (3, 1, 1)
        assert np.ravel(stats[name]) == pytest.approx(wanted)
    for name, share in QUANTILES.items():
        assert np.ravel(stats[name]) == pytest.approx(np.quantile(pixels, share, axis=0), abs=1 / 255)
    assert stats["count"] == [4]


# --- what is left out, and what is refused ----------------------------------------------------------


def test_what_makes_no_episode_is_left_out_with_a_word(
    libraries: object, fetched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [
        fetched,
        recorded(tmp_path / "idle.mcap"),
        recorded(tmp_path / "blind.mcap", WHOLE, blind=range(200)),
        recorded(tmp_path / "large.mcap", WHOLE, size=(32, 24)),
        recorded(tmp_path / "cut.mcap", Told("red_can", 10, 110, None)),
    ]
    assert main(["export", *map(str, files), "--lerobot", str(tmp_path / "set"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["written"] == [{"path": str(tmp_path / "set"), "episodes": 2, "succeeded": 1, "rows": 42}]
    for word in (
        "idle.mcap: it has no task",
        "blind.mcap: it has no pictures",
        "32 x 24 pixels",
        "no outcome",
        "depth",
    ):
        assert sum(word in line for line in said["left_out"]) == 1


def test_no_episode_at_all_is_an_error_that_leaves_nothing(
    libraries: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded(tmp_path / "idle.mcap")
    assert main(["export", str(path), "--lerobot", str(tmp_path / "set")]) == 1
    assert "no task makes an episode" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == [path]


def test_a_film_needs_pictures_with_even_sides(libraries: object, tmp_path: Path) -> None:
    path = recorded(tmp_path / "odd.mcap", WHOLE, size=(15, 12))
    with pytest.raises(CaptureError, match="15 x 12"):
        lerobot.export([path], tmp_path / "set")
    assert [*tmp_path.iterdir()] == [path]


def test_a_picture_that_cannot_be_read_is_replaced_by_the_one_before(
    fetched: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = episode_of(fetched)
    with Tables.open(fetched) as capture:
        recording = Recording(capture, ROBOT)
        whole = [picture.tobytes() for picture in recording.pictures(episode)]
        frames = [seen for seen in capture.frames() if seen.stamp_ns != episode.pictures_ns[3]]

        def without(_self: Tables, **_between: float) -> Iterator[Frame]:
            return iter(frames)

        monkeypatch.setattr(Tables, "frames", without)
        shown = [picture.tobytes() for picture in recording.pictures(episode)]
    assert shown == [*whole[:3], whole[2], *whole[4:]]


def test_what_does_not_go_together_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, film = str(tmp_path / "set"), str(tmp_path / "film.mp4")
    for words, reason in (
        ([str(GOLDEN), str(GOLDEN), "--video", film], "several captures"),
        ([str(GOLDEN), "--lerobot", out, "--video", film], "by another command"),
        ([str(GOLDEN), "--video", film, "--fps", "10"], "--fps is the rate of --lerobot"),
    ):
        assert main(["export", *words]) == 2
        assert reason in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


def test_a_folder_without_captures_and_an_existing_place_are_refused(libraries: object, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no captures are in this folder"):
        lerobot.export([tmp_path], tmp_path / "set")
    with pytest.raises(CaptureError, match="exists; remove it"):
        lerobot.export([GOLDEN], tmp_path)


def test_missing_libraries_are_named_with_their_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(CaptureError, match=r"pip install 'cocoro-mesh\[lerobot\]'"):
        lerobot.export([GOLDEN], tmp_path / "set")
