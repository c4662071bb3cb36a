"""Frames for a network: exact depth, refusal of what is damaged, and what a slow way makes of the size."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from cocoro.messages import Frame, PackedFrame
from services.frames.packing import pack, unpack

SIZES = st.tuples(st.integers(1, 24), st.integers(1, 24))
CODES = arrays.arrays(np.dtype("<u2"), SIZES, elements=st.integers(0, 2047))


def frame_of(depth: np.ndarray, colour: int = 90) -> Frame:
    height, width = depth.shape
    return Frame(
        stamp_ns=17,
        seq=5,
        incarnation=9,
        width=width,
        height=height,
        colour=np.full(height * width * 3, colour, np.uint8).data,
        depth=np.ascontiguousarray(depth).reshape(-1).view(np.uint8).data,
    )


@given(CODES)
def test_depth_is_unpacked_exactly_and_stamp_and_numbers_stay(depth: np.ndarray) -> None:
    frame = frame_of(depth)
    found = unpack(msgspec.msgpack.decode(msgspec.msgpack.encode(pack(frame)), type=PackedFrame))
    assert bytes(found.depth) == bytes(frame.depth)
    assert (found.stamp_ns, found.seq, found.incarnation) == (17, 5, 9)
    assert np.abs(np.frombuffer(found.colour, np.uint8).astype(int) - 90).max() <= 3


@given(CODES, st.just(2))
def test_a_smaller_frame_has_codes_of_the_large_one_alone(depth: np.ndarray, divisor: int) -> None:
    frame = frame_of(depth)
    found = unpack(pack(frame, divisor))
    exact = depth.shape[0] % divisor == 0 and depth.shape[1] % divisor == 0
    divided = divisor if exact else 1
    assert (found.height, found.width) == (depth.shape[0] // divided, depth.shape[1] // divided)
    assert {*np.frombuffer(found.depth, "<u2").tolist()} <= {*depth.reshape(-1).tolist()}


GOOD = pack(frame_of(np.arange(48, dtype="<u2").reshape(6, 8)))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"colour": b""}, "no JPEG"),
        ({"colour": b"\xff\xd8\xff"}, "no JPEG"),
        ({"colour": GOOD.colour[:200]}, "colour"),
        ({"width": 6, "height": 8}, "8 x 6, not 6 x 8"),
        ({"colour": pack(frame_of(np.zeros((60, 80), "<u2"))).colour}, "80 x 60"),
        ({"depth": b"\x00"}, "depth"),
        ({"depth": GOOD.depth[:-4]}, "depth"),
        ({"depth": b"foreign" * 9}, "depth"),
        ({"depth": zstandard.compress(bytes(95))}, "95 bytes, 96 are expected"),
        ({"depth": zstandard.compress(bytes(1 << 26))}, "96 are expected"),
        ({"depth": zstandard.ZstdCompressor(write_content_size=False).compress(bytes(96))}, "96 are expected"),
    ],
)
def test_what_is_damaged_is_refused_with_the_reason(changes: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        unpack(msgspec.structs.replace(GOOD, **changes))


@given(st.data())
def test_no_damage_makes_anything_but_a_frame_of_that_size_or_a_refusal(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["colour", "depth"]))
    damaged = bytearray(getattr(GOOD, name))
    for at in data.draw(st.lists(st.integers(0, len(damaged) - 1), min_size=1, max_size=4)):
        damaged[at] = data.draw(st.integers(0, 255))
    try:
        found = unpack(msgspec.structs.replace(GOOD, **{name: bytes(damaged)}))
    except ValueError:
        return
    assert (found.width, found.height) == (8, 6)
