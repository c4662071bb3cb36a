"""`cocoro.open`: a capture as columns."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as PackageWriter

import cocoro
from cocoro.capture.columns import Columns, MissingColumnError, flattened
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError
from cocoro.messages import BaseState, Detections, PlannerStatus

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


def looped(topic: str) -> list[msgspec.Struct]:
    with Capture.open(GOLDEN) as capture:
        return [capture.read(record) for record in capture.messages(topic)]


# --- a recorded fetch -----------------------------------------------------------------------------


def test_the_columns_of_a_topic_are_the_fields_of_its_messages() -> None:
    states = [state for state in looped("base/state") if isinstance(state, BaseState)]
    with cocoro.open(GOLDEN) as capture:
        base = capture["base/state"]
    assert base.rows == len(states) > 100
    assert base["stamp_ns"].tolist() == [state.stamp_ns for state in states]
    assert base["speed_mps"].tolist() == [state.speed_mps for state in states]
    assert base["odometry_m"].tolist() == [list(state.odometry_m) for state in states]
    assert base["charging"].dtype == np.bool_
    assert base["mode"].tolist() == [state.mode for state in states]
    assert set(base) - {"log_ns", "time_s"} == set(BaseState.__struct_fields__)


def test_the_times_of_recording_come_first_and_count_from_the_captures_begin() -> None:
    with Capture.open(GOLDEN) as capture:
        log_ns = [record.log_ns for record in capture.messages("base/state")]
        begin_ns = capture.start_ns
    with cocoro.open(GOLDEN) as tables:
        base = tables["base/state"]
    assert [*base][:5] == ["log_ns", "time_s", "stamp_ns", "seq", "incarnation"]
    assert base["log_ns"].tolist() == log_ns
    assert base["time_s"] == pytest.approx((np.array(log_ns) - begin_ns) / NS)


def test_what_is_within_a_field_is_named_with_dots_and_nan_where_it_is_missing() -> None:
    plans = [plan for plan in looped("planning/status") if isinstance(plan, PlannerStatus)]
    with cocoro.open(GOLDEN) as capture:
        plan = capture["planning/status"]
    ages_s = [np.nan if one.target is None else one.target.age_s for one in plans]
    assert None in [one.target for one in plans]
    np.testing.assert_equal(plan["target.age_s"], np.array(ages_s))
    assert plan["target.position_m"].shape == (len(plans), 3)
    labels = [None if one.target is None else one.target.label for one in plans]
    assert plan["target.label"].tolist() == labels


def test_a_tuple_of_structs_is_a_table_of_its_own() -> None:
    seen = [one for one in looped("perception/detections") if isinstance(one, Detections)]
    with cocoro.open(GOLDEN) as capture:
        detections = capture["perception/detections"].exploded("detections")
    each = [(row, one.label) for row, message in enumerate(seen) for one in message.detections]
    assert [*zip(detections["row"].tolist(), detections["label"].tolist(), strict=True)] == each
    assert detections["box_px"].shape == (len(each), 4)


def test_topics_that_are_loaded_together_are_as_those_that_are_asked_for_alone() -> None:
    topics = ("base/state", "arm/state", "executive/task")
    with cocoro.open(GOLDEN) as together, cocoro.open(GOLDEN) as alone:
        together.load(*topics)
        for topic in topics:
            assert [*together[topic]] == [*alone[topic]]
            assert together[topic].rows == alone[topic].rows
            assert together[topic] is together[topic]


def test_every_topic_of_a_capture_can_be_read_and_no_message_is_missing() -> None:
    with Capture.open(GOLDEN) as capture:
        counts = {key.partition("/")[2]: len([*capture.messages(key)]) for key in capture.keys}
    with cocoro.open(GOLDEN) as tables:
        tables.load(*tables)
        assert {topic: tables[topic].rows for topic in tables} == counts
        assert tables.problems == []
        assert "base/state" in tables
        assert f"{len(counts)} topics" in repr(tables)


def test_pictures_are_read_one_by_one_and_their_times_are_columns() -> None:
    with cocoro.open(GOLDEN) as capture:
        times = capture["kinect/frame"]
        frames = [*capture.frames()]
        assert [frame.stamp_ns for frame in frames] == times["stamp_ns"].tolist()
        assert "colour" not in times
        middle_s = float(times["time_s"][len(frames) // 2])
        assert [frame.stamp_ns for frame in capture.frames(start_s=middle_s)] == times["stamp_ns"].tolist()[
            -len(frames) // 2 :
        ]
        assert len([*capture.frames(end_s=middle_s)]) == len(frames) // 2


def test_a_topic_or_column_that_is_not_there_is_told_with_what_is_meant() -> None:
    with cocoro.open(GOLDEN) as capture:
        with pytest.raises(MissingColumnError, match=r"no topic 'base/stat'.*did you mean base/state"):
            capture["base/stat"]
        with pytest.raises(KeyError, match=r"no column 'speed'; known are .*speed_mps"):
            capture["base/state"]["speed"]
        with pytest.raises(MissingColumnError):
            next(capture.frames("no/frame"))


def test_a_capture_is_found_by_its_name_in_place_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COCORO_CAPTURE_DIR", str(tmp_path))
    kept = tmp_path / "calliope-20261201T000000Z-001-fetch-red_can.mcap"
    kept.write_bytes(GOLDEN.read_bytes())
    for name in ("latest", "fetch", "fetch red_can"):
        with cocoro.open(name) as capture:
            assert capture.path == kept
    with cocoro.open() as capture:
        assert capture.path == kept


def test_what_is_no_capture_is_told(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no capture")
    with pytest.raises(CaptureError, match="no MCAP file"):
        cocoro.open(tmp_path / "notes.txt")
    with pytest.raises(CaptureError, match="cannot be read"):
        cocoro.open(tmp_path / "absent.mcap")


def test_opening_captures_leaves_pythons_own_open_as_it_is() -> None:
    names: dict[str, object] = {}
    exec("from cocoro import *", names)
    assert "open" not in names
    assert names["Topic"] is cocoro.Topic
    assert names["__builtins__"]["open"] is builtins.open  # type: ignore[index]


# --- files of others, and damaged ones ------------------------------------------------------------


def written(path: Path, *messages: tuple[str, str, bytes]) -> Path:
    """A file by the `mcap` package: topic, encoding and payload of each message, a millisecond apart."""
    with path.open("wb") as file:
        writer = PackageWriter(file, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[str, int] = {}
        for number, (topic, encoding, payload) in enumerate(messages):
            if topic not in channels:
                channels[topic] = writer.register_channel(f"robot/{topic}", encoding, 0)
            writer.add_message(channels[topic], number * 1_000_000 + 1, payload, number, number)
        writer.finish()
    return path


def test_messages_of_other_programs_are_columns_of_their_maps(tmp_path: Path) -> None:
    encode = msgspec.msgpack.encode
    path = written(
        tmp_path / "other.mcap",
        ("gps/fix", "msgpack", encode({"lat_deg": 48.1, "sats": 7, "fix": {"kind": "rtk"}})),
        ("gps/fix", "msgpack", encode({"lat_deg": 48.2, "sats": 8, "note": "late"})),
        ("notes", "json", b'{"text": "hello"}'),
        ("plain", "text", b"hello"),
    )
    with cocoro.open(path) as capture:
        fix = capture["gps/fix"]
        assert fix["lat_deg"].tolist() == [48.1, 48.2]
        assert fix["sats"].tolist() == [7, 8]
        assert fix["fix.kind"].tolist() == ["rtk", None]
        assert fix["note"].tolist() == [None, "late"]
        assert capture["notes"]["text"].tolist() == ["hello"]
        assert capture["plain"]["value"].tolist() == [b"hello"]


def test_a_message_that_does_not_fit_costs_only_itself_and_is_told(tmp_path: Path) -> None:
    with Capture.open(GOLDEN) as capture:
        good = [bytes(record.payload) for record in capture.messages("base/state")][:3]
    path = written(tmp_path / "x.mcap", *(("base/state", "msgpack", payload) for payload in (*good, b"\xc1", *good)))
    with cocoro.open(path) as tables:
        assert tables["base/state"].rows == 6
        assert tables["base/state"]["log_ns"].tolist()[3] == 4_000_001
        assert "base/state" in tables.problems[0]


@pytest.mark.sweep
def test_damage_anywhere_takes_no_more_than_the_loop_over_messages_loses(tmp_path: Path) -> None:
    whole = GOLDEN.read_bytes()
    path = tmp_path / "damaged.mcap"
    for at in range(1000, len(whole) - 1000, len(whole) // 10):
        path.write_bytes(whole[:at] + b"\0" * 64 + whole[at + 64 :])
        with Capture.open(path) as capture:
            there = [record.log_ns for record in capture.messages("base/state")]
            known = "calliope/base/state" in capture.keys
        with cocoro.open(path) as tables:
            assert ("base/state" in tables) == known
            if known:
                assert tables["base/state"]["log_ns"].tolist() == there


def test_an_index_that_leaves_messages_out_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    from cocoro.capture import bulk

    indexed = bulk._indexed
    monkeypatch.setattr(bulk, "_indexed", lambda *arguments: list(indexed(*arguments))[1:])
    with cocoro.open(GOLDEN) as capture:
        assert capture["base/state"].rows == len(looped("base/state"))
        assert capture.problems == []


# --- columns --------------------------------------------------------------------------------------


def test_fields_become_columns_by_what_they_hold() -> None:
    columns = flattened(
        [
            {
                "whole": 1,
                "huge": 1 << 63,
                "real": 1,
                "maybe": 1,
                "flag": True,
                "pair": (1, 2),
                "list": [1],
                "map": {"a": 1},
            },
            {
                "whole": 2,
                "huge": 2,
                "real": 0.5,
                "maybe": None,
                "flag": False,
                "pair": (3, 4),
                "list": [],
                "map": {"a": 2},
            },
        ]
    )
    kinds = {name: (column.dtype.kind, column.shape) for name, column in columns.items()}
    assert kinds == {
        "whole": ("i", (2,)), "huge": ("O", (2,)), "real": ("f", (2,)), "maybe": ("f", (2,)), "flag": ("b", (2,)),
        "pair": ("i", (2, 2)), "list": ("O", (2,)), "map.a": ("i", (2,)),
    }  # fmt: skip
    assert np.isnan(columns["maybe"][1])
    assert flattened([]) == {}


def test_a_tuple_that_is_missing_is_nan() -> None:
    place = flattened([{"place_m": (1.0, 2.0)}, {"place_m": None}])["place_m"]
    np.testing.assert_equal(place, [[1.0, 2.0], [np.nan, np.nan]])


def columns_of_base() -> Columns:
    with cocoro.open(GOLDEN) as capture:
        return capture["base/state"]


def test_flat_columns_have_one_value_a_row() -> None:
    flat = columns_of_base().flat()
    assert {"odometry_m.0", "odometry_m.1"} < set(flat)
    assert {column.ndim for column in flat.values()} == {1}


def test_a_table_of_pyarrow_has_the_flat_columns() -> None:
    pytest.importorskip("pyarrow", reason="pip install 'cocoro-mesh[tables]'")
    base = columns_of_base()
    assert base.to_arrow().column_names == [*base.flat()]


def test_a_data_frame_of_pandas_has_the_flat_columns() -> None:
    pandas = pytest.importorskip("pandas", reason="pip install pandas")
    base = columns_of_base()
    assert isinstance(base.to_pandas(), pandas.DataFrame)
    assert [*base.to_pandas().columns] == [*base.flat()]


@pytest.mark.parametrize("library", ["pandas", "pyarrow"])
def test_without_the_library_it_is_said_what_to_install(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    base = columns_of_base()
    with pytest.raises(ConfigError, match="pip install"):
        base.to_pandas() if library == "pandas" else base.to_arrow()
