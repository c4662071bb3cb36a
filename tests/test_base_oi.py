"""The Open Interface's bytes are those of the manual, and only complete frames are accepted."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_base import frame

from services.base import oi
from services.base.guard_logic import LONG, SHORT


def readings_of(packets: tuple[int, ...]) -> st.SearchStrategy[oi.Readings]:
    values = st.tuples(*(st.integers(oi.PACKETS[packet].low, oi.PACKETS[packet].high) for packet in packets))
    return values.map(lambda drawn: dict(zip(packets, drawn, strict=True)))


FRAMES = st.sampled_from((SHORT, LONG)).flatmap(readings_of)


def test_the_manuals_own_examples() -> None:
    assert oi.drive(-200, 500) == bytes([137, 255, 56, 1, 244])
    assert oi.start() == bytes([128])
    assert oi.enter("safe") == bytes([131])
    assert oi.enter("full") == bytes([132])


def test_the_manuals_example_of_a_stream_is_read() -> None:
    parser = oi.StreamParser([(29, 13)])
    assert parser.feed(bytes([19, 5, 29, 2, 25, 13, 0, 163])) == [{29: 537, 13: 0}]
    assert parser.skipped == 0
    assert oi.stream((29, 13)) == bytes([148, 2, 29, 13])


def test_drive_direct_says_right_before_left() -> None:
    assert oi.drive_direct(100, -200) == bytes([145, 0xFF, 0x38, 0, 100])
    assert oi.drive_direct(9999, -9999) == oi.drive_direct(500, -500)


def test_a_list_that_does_not_fit_into_15_ms_is_refused() -> None:
    oi.stream(LONG)
    with pytest.raises(ValueError, match="15 ms"):
        oi.stream(LONG * 2)


@given(st.integers(-600, 600))
def test_a_harmless_speed_has_no_byte_that_is_an_opcode_and_is_near(speed: int) -> None:
    harmless = oi.harmless(speed)
    assert abs(harmless) <= 500
    assert abs(harmless - min(max(speed, -500), 500)) <= 16
    assert not set(harmless.to_bytes(2, "big", signed=True)) & set(oi.OPCODES)
    assert oi.harmless(harmless) == harmless
    assert oi.harmless(0) == 0


@given(st.lists(FRAMES, max_size=5), st.integers(1, 50))
def test_frames_are_read_however_they_are_cut(frames: list[oi.Readings], cut: int) -> None:
    data = b"".join(map(frame, frames))
    parser = oi.StreamParser((SHORT, LONG))
    read = [found for at in range(0, len(data), cut) for found in parser.feed(data[at : at + cut])]
    assert read == frames
    assert parser.skipped == 0


@given(FRAMES, st.data())
def test_a_changed_byte_never_gets_through(readings: oi.Readings, data: st.DataObject) -> None:
    good = bytearray(frame(readings))
    at = data.draw(st.integers(0, len(good) - 1))
    good[at] ^= data.draw(st.integers(1, 255))
    assert oi.StreamParser((SHORT, LONG)).feed(bytes(good)) == []


@given(FRAMES, FRAMES, st.data())
def test_after_a_broken_frame_the_next_but_one_is_read_at_the_latest(
    readings: oi.Readings, after: oi.Readings, data: st.DataObject
) -> None:
    bad = bytearray(frame(readings))
    del bad[data.draw(st.integers(0, len(bad) - 1))]
    parser = oi.StreamParser((SHORT, LONG))
    read = parser.feed(bytes(bad) + frame(after) + frame(after) + frame(after))
    assert read
    assert all(found == after for found in read)
    assert parser.skipped > 0


@given(st.binary(max_size=400))
def test_rubbish_gives_nothing(rubbish: bytes) -> None:
    parser = oi.StreamParser((SHORT, LONG))
    for readings in parser.feed(rubbish):  # should hypothesis ever write a whole frame, it is one
        assert frame(readings) in rubbish


def test_a_frame_of_packets_that_were_not_asked_for_is_none() -> None:
    assert oi.StreamParser((SHORT,)).feed(frame({oi.MODE: 2})) == []


def test_a_value_that_the_manual_does_not_know_makes_the_frame_a_bad_one() -> None:
    readings = dict.fromkeys(SHORT, 0)
    assert oi.StreamParser((SHORT,)).feed(frame(readings)) == [readings]
    assert oi.StreamParser((SHORT,)).feed(frame(readings | {oi.MODE: 4})) == []
    assert oi.StreamParser((SHORT,)).feed(frame(readings | {oi.LEFT_SPEED: 501})) == []


def test_a_frame_that_tells_a_packet_twice_is_a_bad_one() -> None:
    """A frame that is as long as the other list, with a sum that is right by chance."""
    good = frame(dict.fromkeys(SHORT, 0))
    body = good[:-1] + bytes([oi.VOLTAGE, 0, 1, oi.CURRENT, 0, 2])
    body = bytes([19, len(body) - 2]) + body[2:]
    assert len(body) - 2 == oi.length(LONG)
    assert oi.StreamParser((SHORT, LONG)).feed(body + bytes([-sum(body) & 0xFF])) == []
