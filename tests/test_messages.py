"""Every message of the tables: what is good goes round unchanged, what is not is refused."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_samples import MESSAGES, QUESTIONS, data_of, leaves_in, numbers_in, replaced

from cocoro import publisher
from cocoro.messages import BaseCommand, Frame, Message, ServoCommand, ServoState
from cocoro.publisher import encode

every_message = pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
few = settings(max_examples=25)
everything = pytest.mark.parametrize("kind", MESSAGES + QUESTIONS, ids=lambda kind: kind.__name__)


def decoded(kind: type[msgspec.Struct], data: Any) -> Any:
    return msgspec.msgpack.decode(msgpack.packb(data), type=kind)


def contains(whole: Any, part: Any) -> bool:
    """Whether the whole has what the part has, and perhaps more fields."""
    if isinstance(part, dict):
        return all(key in whole and contains(whole[key], value) for key, value in part.items())
    if isinstance(part, list):
        return len(whole) == len(part) and all(map(contains, whole, part))
    return bool(whole == part)


@everything
@few
@given(data=st.data())
def test_it_goes_round_unchanged(kind: type[msgspec.Struct], data: st.DataObject) -> None:
    message = decoded(kind, data.draw(data_of(kind)))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(message), type=kind) == message


@everything
@few
@given(data=st.data())
def test_a_reader_that_knows_nothing_of_this_project_reads_every_field(
    kind: type[msgspec.Struct], data: st.DataObject
) -> None:
    sent = data.draw(data_of(kind))
    foreign = msgpack.unpackb(msgspec.msgpack.encode(decoded(kind, sent)))
    assert contains(foreign, sent)
    assert set(foreign) == {field.encode_name for field in msgspec.structs.fields(kind)}


@everything
@few
@given(data=st.data(), bad=st.sampled_from([math.nan, math.inf, -math.inf, 1e300]))
def test_a_number_that_is_none_is_refused_wherever_it_stands(
    kind: type[msgspec.Struct], data: st.DataObject, bad: float
) -> None:
    sent = data.draw(data_of(kind))
    places = list(numbers_in(sent))
    if not places:
        return
    with pytest.raises(msgspec.ValidationError):
        decoded(kind, replaced(sent, data.draw(st.sampled_from(places)), bad))


@every_message
@few
@given(data=st.data())
def test_what_has_the_wrong_type_is_refused_wherever_it_stands(kind: type[Message], data: st.DataObject) -> None:
    free = {field.encode_name for field in msgspec.structs.fields(kind) if field.type is Any}
    sent = data.draw(data_of(kind))
    place = data.draw(st.sampled_from([path for path in leaves_in(sent) if path[0] not in free]))
    with pytest.raises(msgspec.ValidationError):
        decoded(kind, replaced(sent, place, msgpack.ExtType(42, b"")))


@every_message
@few
@given(data=st.data())
def test_what_is_cut_short_is_refused(kind: type[Message], data: st.DataObject) -> None:
    payload = msgpack.packb(data.draw(data_of(kind)))
    with pytest.raises(msgspec.MsgspecError):
        msgspec.msgpack.decode(payload[: data.draw(st.integers(0, len(payload) - 1))], type=kind)


@every_message
@few
@given(data=st.data())
def test_fields_of_a_newer_version_are_passed_over(kind: type[Message], data: st.DataObject) -> None:
    sent = data.draw(data_of(kind))
    assert decoded(kind, sent | {"of_a_later_version": [1, {}]}) == decoded(kind, sent)


@every_message
def test_what_it_says_of_itself_never_counts_backwards(kind: type[Message]) -> None:
    for name in ("seq", "incarnation"):
        with pytest.raises(msgspec.ValidationError, match=name):
            decoded(kind, {name: -1})


@pytest.mark.parametrize("name", ["colour", "depth"])
def test_a_frame_whose_pixels_are_not_as_many_as_it_says_is_refused(name: str) -> None:
    good = {"width": 4, "height": 2, "colour": bytes(24), "depth": bytes(16)}
    assert decoded(Frame, good).width == 4
    with pytest.raises(msgspec.ValidationError, match=f"{name} has 3 bytes, 4 x 2 needs"):
        decoded(Frame, good | {name: b"\0\0\0"})


def test_a_frames_pixels_are_read_in_place() -> None:
    payload = msgpack.packb({"width": 1, "height": 1, "colour": b"rgb", "depth": b"\xff\x07"})
    frame = msgspec.msgpack.decode(payload, type=Frame)
    assert isinstance(frame.colour, memoryview)
    assert frame.colour.obj is payload


@pytest.mark.parametrize(
    ("kind", "lists"),
    [(ServoState, ("position_rad", "speed_radps", "load")), (ServoCommand, ("goal_rad", "speed_radps"))],
)
def test_servos_have_as_many_values_as_joints(kind: type[Message], lists: tuple[str, ...]) -> None:
    good: dict[str, Any] = {"joints": ["elbow"]} | {name: [0.5] for name in lists}
    assert decoded(kind, good).joints == ("elbow",)
    for name in lists:
        with pytest.raises(msgspec.ValidationError, match=f"{name} has 2 values for 1 joints"):
            decoded(kind, good | {name: [0.5, 0.5]})


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_command_that_is_no_number_cannot_even_be_made(bad: float) -> None:
    with pytest.raises(ValueError, match="ahead_mps must be finite"):
        BaseCommand(ahead_mps=bad, turn_radps=0.0)
    with pytest.raises(ValueError, match="goal_rad must be finite"):
        ServoCommand(joints=("elbow",), goal_rad=(bad,), speed_radps=(1.0,))


def test_a_servos_speed_limit_is_not_negative() -> None:
    with pytest.raises(msgspec.ValidationError, match=r"speed_radps"):
        decoded(ServoCommand, {"joints": ["elbow"], "goal_rad": [0.0], "speed_radps": [-1.0]})


def test_numpys_numbers_are_sent_as_numbers_and_found_by_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    command = BaseCommand(ahead_mps=np.float64(0.25), turn_radps=np.float32(0.5))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a float64 is in a message"):
        encode(command)
    monkeypatch.setattr(publisher, "_ENCODER", msgspec.msgpack.Encoder(enc_hook=publisher._numpy_scalar))
    assert msgspec.msgpack.decode(encode(command), type=BaseCommand) == BaseCommand(ahead_mps=0.25, turn_radps=0.5)
