"""Perception over time: the head angles that a frame is localised with, which frames wait, and which are dropped."""

from collections.abc import Sequence
from math import hypot

import pytest
from perception_scenes import MS, STAMP_NS, Canvas, error_mm, head_at, known, perception, seen, the

from cocoro.core import Output, Sample
from cocoro.messages import Detections, Frame, ServoState
from cocoro.topics import ARM_STATE, FRAME

LABEL = "red_can"


def frame(stamp_ns: int = STAMP_NS, **more: int) -> Frame:
    canvas = Canvas()
    canvas.rectangle(LABEL, (320, 240), 1.0)
    return canvas.frame(stamp_ns, **more)


def messages(outputs: Sequence[Output]) -> list[Detections]:
    """The detections among a step's outputs."""
    return [output.message for output in outputs if isinstance(output.message, Detections)]


def test_it_reads_every_arm_state_but_only_the_newest_frame() -> None:
    core = perception()
    assert dict(core.reads) == {FRAME: "latest", ARM_STATE: "all"}
    assert core.schedule.rate_hz is None
    assert set(core.schedule.triggers) == {FRAME, ARM_STATE}


def test_detections_carry_the_frames_stamp_and_identity() -> None:
    core = perception()
    shown = frame(seq=41, incarnation=7)
    (message,) = messages(
        core.step([head_at(STAMP_NS - 10 * MS), head_at(STAMP_NS + 10 * MS), Sample(FRAME, shown)], STAMP_NS + 20 * MS)
    )
    assert isinstance(message, Detections)
    assert message.stamp_ns == STAMP_NS
    assert (message.frame_seq, message.frame_incarnation) == (41, 7)
    assert (message.width, message.height) == (640, 480)


def test_a_frame_without_objects_still_tells_that_there_are_none() -> None:
    message = seen(Canvas().frame())
    assert message.detections == ()
    assert message.pan_rad == 0.0


def test_the_head_angles_are_those_of_the_frames_stamp() -> None:
    core = perception()
    states = [head_at(STAMP_NS - 15 * MS, 0.1, -0.2), head_at(STAMP_NS + 5 * MS, 0.3, -0.6)]
    (message,) = messages(core.step([*states, Sample(FRAME, frame())], STAMP_NS + 20 * MS))
    assert message.pan_rad == pytest.approx(0.25)
    assert message.tilt_rad == pytest.approx(-0.5)


def test_a_frame_waits_for_the_head_angles_after_its_stamp() -> None:
    core = perception()
    assert not core.step([head_at(STAMP_NS - 5 * MS, 0.1), Sample(FRAME, frame())], STAMP_NS + 20 * MS)
    (message,) = messages(core.step([head_at(STAMP_NS + 15 * MS, 0.5)], STAMP_NS + 25 * MS))
    assert message.pan_rad == pytest.approx(0.2)
    assert the(LABEL, message).position_m is not None
    assert not core.step([head_at(STAMP_NS + 35 * MS)], STAMP_NS + 45 * MS)


def test_after_the_wait_it_goes_out_without_positions_and_says_why() -> None:
    core = perception(bracket_wait_s=0.05)
    assert not core.step([head_at(STAMP_NS - 5 * MS), Sample(FRAME, frame())], STAMP_NS + 20 * MS)
    assert not core.step([], STAMP_NS + 69 * MS)
    (message,) = messages(core.step([], STAMP_NS + 70 * MS))
    found = the(LABEL, message)
    assert found.position_m is None
    assert found.note == "no head angles"
    assert found.depth_m == pytest.approx(1.0, abs=0.01)
    assert (message.pan_rad, message.tilt_rad) == (None, None)
    assert core.unlocalised_frames == 1


def test_head_angles_are_not_taken_across_a_silence() -> None:
    core = perception(max_head_gap_s=0.15)
    states = [head_at(STAMP_NS - 100 * MS), head_at(STAMP_NS + 60 * MS)]
    (message,) = messages(core.step([*states, Sample(FRAME, frame())], STAMP_NS + 70 * MS))
    assert the(LABEL, message).note == "no head angles"


def test_a_frame_from_before_the_first_head_angles_does_not_wait_in_vain() -> None:
    core = perception()
    (message,) = messages(core.step([head_at(STAMP_NS + 5 * MS), Sample(FRAME, frame())], STAMP_NS + 20 * MS))
    assert the(LABEL, message).note == "no head angles"


def test_waiting_frames_go_out_in_order_each_with_its_own_angles() -> None:
    core = perception(bracket_wait_s=0.2)
    core.step([head_at(STAMP_NS - 5 * MS, 0.0)], STAMP_NS)
    for number in range(3):
        shown = frame(STAMP_NS + 33 * number * MS, seq=number)
        assert not core.step([Sample(FRAME, shown)], STAMP_NS + (20 + 33 * number) * MS)
    outputs = messages(core.step([head_at(STAMP_NS + 95 * MS, 1.0)], STAMP_NS + 100 * MS))
    assert [message.frame_seq for message in outputs] == [0, 1, 2]
    assert [message.pan_rad for message in outputs] == pytest.approx([0.05, 0.38, 0.71])


def test_an_old_frame_is_dropped_and_counted() -> None:
    core = perception(max_frame_age_s=0.5)
    states = [head_at(STAMP_NS - 10 * MS), head_at(STAMP_NS + 10 * MS)]
    assert not core.step([*states, Sample(FRAME, frame())], STAMP_NS + 501 * MS)
    assert core.stale_frames == 1
    assert (
        core.step([Sample(FRAME, frame())], STAMP_NS + 500 * MS - 1) == []
    )  # the clock restarted: no head angles are known
    assert core.stale_frames == 1


def test_an_arm_state_without_the_neck_is_no_head_angle() -> None:
    core = perception()
    sample = head_at(STAMP_NS - 10 * MS)
    assert isinstance(sample.message, ServoState)
    sample.message.joints = ("elbow", "wrist_pitch", "neck_pan")
    core.step([sample, head_at(STAMP_NS + 10 * MS)], STAMP_NS + 10 * MS)
    (message,) = messages(core.step([Sample(FRAME, frame())], STAMP_NS + 20 * MS))
    assert message.pan_rad is None


def test_a_restarted_arm_service_brings_no_angles_from_before() -> None:
    core = perception()
    states = [head_at(STAMP_NS - 10 * MS, incarnation=1), head_at(STAMP_NS + 10 * MS, incarnation=2)]
    (message,) = messages(core.step([*states, Sample(FRAME, frame())], STAMP_NS + 20 * MS))
    assert message.pan_rad is None


def test_a_new_epoch_of_the_clock_forgets_what_was_pending() -> None:
    core = perception()
    core.step([head_at(STAMP_NS - 5 * MS), Sample(FRAME, frame())], STAMP_NS + 20 * MS)
    outputs = core.step([head_at(0), head_at(20 * MS), Sample(FRAME, frame(10 * MS, seq=5))], 30 * MS)
    (message,) = messages(outputs)
    assert message.frame_seq == 5
    assert the(LABEL, message).position_m is not None


def test_equal_inputs_give_equal_outputs() -> None:
    def run() -> list[Output]:
        core = perception()
        outputs: list[Output] = []
        for step in range(6):
            stamp = STAMP_NS + 33 * step * MS
            canvas = Canvas()
            canvas.rectangle(LABEL, (300 + 7 * step, 240), 1.0 + 0.1 * step)
            inputs = [head_at(stamp - 3 * MS, 0.01 * step), head_at(stamp + 17 * MS, 0.02 * step)]
            outputs += core.step([*inputs, Sample(FRAME, canvas.frame(stamp))], stamp + 20 * MS)
        return outputs

    assert run() == run()


@pytest.mark.sim
def test_with_a_turning_head_the_position_is_right_only_with_the_angles_of_the_stamp() -> None:
    from perception_scenes import Scene

    can = known(LABEL, 1.2, 0.1)
    speed_radps, tilt = 1.5, -0.5

    def pan(stamp_ns: int) -> float:
        return speed_radps * (stamp_ns - STAMP_NS) / 1e9

    with Scene([can]) as scene:
        shown = scene.frame(pan(STAMP_NS), tilt)
    core = perception()
    stamps = [STAMP_NS + offset * MS for offset in (-27, -7, 13)]
    states = [head_at(stamp, pan(stamp), tilt) for stamp in stamps]
    (message,) = messages(core.step([*states, Sample(FRAME, shown)], STAMP_NS + 20 * MS))
    assert message.pan_rad == pytest.approx(0.0, abs=1e-9)
    assert error_mm(the(LABEL, message), can)[0] < 2.0

    newest = the(LABEL, seen(shown, pan(stamps[-1]), tilt))
    assert error_mm(newest, can)[0] > 0.8 * pan(stamps[-1]) * hypot(1.2, 0.1) * 1e3
