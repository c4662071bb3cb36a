"""Exports of captures as film and tables, and what an export refuses."""

from __future__ import annotations

import csv
import resource
from math import pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_rig import Room, drive, record

from apps.captures.export import tables, video
from apps.captures.export.geometry import about_z
from apps.cli.main import main
from cocoro import topics
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.messages import Frame, PlannerStatus, TargetEstimate, TrueObject, Truth

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden capture in the forms that need no extra."""
    folder = tmp_path_factory.mktemp("exported")
    forms = {"--video": "film.mp4", "--csv": "csv"}
    assert (
        main(["export", str(GOLDEN), *(word for form, name in forms.items() for word in (form, str(folder / name)))])
        == 0
    )
    return folder


# --- the film -------------------------------------------------------------------------------------


def test_the_film_lasts_as_long_as_the_capture_and_shows_what_the_robot_saw(exported: Path) -> None:
    film = cv2.VideoCapture(str(exported / "film.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == video.RATE_HZ
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (160, 120)
    pictures = []
    while (read := film.read())[0]:
        pictures.append(read[1])
    with Capture.open(GOLDEN) as capture:
        frames = [capture.read(each) for each in capture.messages("kinect/frame")]
        lasts_s = (capture.end_ns - capture.start_ns) / 1e9
    assert len(pictures) / video.RATE_HZ == pytest.approx(lasts_s, abs=0.2)
    last = frames[-1]
    assert isinstance(last, Frame)
    seen = np.frombuffer(last.colour, np.uint8).reshape(120, 160, 3)[:90, :, ::-1]
    difference = np.abs(pictures[-1][:90].astype(int) - seen.astype(int))
    assert np.median(difference) < 12  # except for what is drawn in, and the film's compression


def test_a_capture_without_pictures_makes_no_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def blind(room: Room) -> None:
        await drive(room, 0.5, frames=False)

    path = record(tmp_path / "blind.mcap", blind)
    assert main(["export", str(path), "--video", str(tmp_path / "film.mp4")]) == 1
    assert "it has no pictures" in capsys.readouterr().err
    assert main(["export", str(path)]) == 2


def test_a_film_that_the_disk_did_not_take_whole_is_no_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        assert main(["export", str(GOLDEN), "--video", str(tmp_path / "film.mp4")]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "could not be written to its end" in capsys.readouterr().err
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize(
    ("form", "name", "words"),
    [
        ("--video", "film.avi", "name ends with .mp4"),
        ("--video", "file/in/film.mp4", "film.mp4: Not a directory"),
        ("--foxglove", "file/in/fox.mcap", "fox.mcap: Not a directory"),
        ("--csv", "file", "arm_alive.csv: "),
    ],
)
def test_a_place_where_nothing_can_be_written_is_told_in_one_line(
    form: str, name: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if form == "--foxglove":
        pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")
    (tmp_path / "file").write_text("no folder")
    assert main(["export", str(GOLDEN), form, str(tmp_path / name)]) == 1
    err = capsys.readouterr().err
    assert words in err
    assert len(err.splitlines()) == 1


# --- tables ---------------------------------------------------------------------------------------


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_each_key_is_a_table_with_a_column_for_each_number(exported: Path) -> None:
    states = _rows(exported / "csv" / "base_state.csv")
    with Capture.open(GOLDEN) as capture:
        records = list(capture.messages("base/state"))
        recorded = [capture.decode(each) for each in records]
        joints = capture.decode(next(capture.messages("arm/state")))["joints"]
    assert [float(row["odometry_m.0"]) for row in states] == [state["odometry_m"][0] for state in recorded]
    assert [int(row["stamp_ns"]) for row in states] == [each.publish_ns for each in records]
    assert _rows(exported / "csv" / "kinect_frame.csv")[0]["colour.bytes"] == str(160 * 120 * 3)
    assert _rows(exported / "csv" / "arm_state.csv")[0]["joints.0"] == joints[0]


def test_what_is_nothing_now_and_then_has_the_columns_of_its_parts_alone(exported: Path) -> None:
    plans = _rows(exported / "csv" / "planning_status.csv")
    assert {"target.label", "target.position_m.0", "hand_m.2", "distance_m"} <= set(plans[0])
    assert not {"target", "hand_m"} & set(plans[0])
    assert {row["target.label"] for row in plans} == {"", "red_can"}


def test_a_list_of_maps_is_a_table_of_its_own(exported: Path) -> None:
    seen = _rows(exported / "csv" / "perception_detections.detections.csv")
    assert {"label", "u_px", "position_m.2", "index", "seq"} <= set(seen[0])
    with Capture.open(GOLDEN) as capture:
        count = sum(len(capture.decode(each)["detections"]) for each in capture.messages("perception/detections"))
    assert len(seen) == count


def test_belief_stands_beside_truth_in_the_body_frame(tmp_path: Path) -> None:
    async def drive_past(room: Room) -> None:
        """The body faces left, along y, and moves 0.1 m between two truths; the can is 1 m to its right."""
        async with room.node("sim") as sim, room.node("planning") as planning:
            can = TrueObject(label="red_can", kind="object", position_m=(2.0, 1.0, 0.06), orientation=(0, 0, 0, 1))
            for tick in range(11):
                place, turn = (1.0, tick / 10, 0.0), about_z(pi / 2)
                truth = Truth(body_m=place, body_orientation=turn, joints_rad={}, objects=(can,))
                sim.publish(topics.TRUTH, truth)
                if tick == 5:
                    await room.clock.sleep_until(room.clock.now_ns() + 10_000_000)
                    believed = TargetEstimate(label="red_can", position_m=(0.5, -1.0, 0.06))
                    planning.publish(topics.PLAN, PlannerStatus(known=(believed,)))
                await room.clock.sleep_until(room.clock.now_ns() + 20_000_000)

    path = record(tmp_path / "truth.mcap", drive_past)
    with Capture.open(path) as capture:
        assert "belief" in tables.export(capture, tables.CsvFolder(tmp_path / "csv"))
    (row,) = _rows(tmp_path / "csv" / "belief.csv")
    gone_m = 0.5 + 0.1 / 3  # 10 of the 30 ms between the truths have passed
    assert (float(row["true_x_m"]), float(row["true_y_m"])) == pytest.approx((1.0 - gone_m, -1.0), abs=1e-6)
    assert float(row["error_m"]) == pytest.approx(0.1 / 3, abs=1e-6)


def test_parquet_needs_pyarrow_or_says_how_to_get_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["export", str(GOLDEN), "--parquet", str(tmp_path / "tables")])
    try:
        import pyarrow.parquet
    except ModuleNotFoundError:
        assert code == 1
        assert "pip install 'cocoro-mesh[tables]'" in capsys.readouterr().err
        return
    assert code == 0
    assert pyarrow.parquet.read_table(tmp_path / "tables" / "base_state.parquet").num_rows == 300


# --- existing files -------------------------------------------------------------------------------


def test_an_export_does_not_write_over_a_file(exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file might be the capture."""
    with Capture.open(GOLDEN) as capture, pytest.raises(CaptureError, match="exists; remove it"):
        video.export(capture, exported / "film.mp4")
    for form in ("--video", "--foxglove", "--rrd"):
        assert main(["export", str(GOLDEN), form, str(exported / "film.mp4")]) == 1
        assert "exists; remove it" in capsys.readouterr().err
    before = GOLDEN.read_bytes()
    assert main(["export", str(GOLDEN), "--csv", str(exported / "more"), "--rrd", str(GOLDEN)]) == 1
    assert "exists; remove it" in capsys.readouterr().err
    assert GOLDEN.read_bytes() == before
    assert not (exported / "more").exists()  # all outputs are checked before the first is made
