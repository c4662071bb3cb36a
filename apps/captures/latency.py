"""From pixel to motor: how long a robot took from a camera's frame to the first wheel command that used it.

The chain is recorded: detections name their frame, and the planner's record of each step names the detections that it
consumed and the wheel command that it produced. A message's time is when the recorder received it, by the machine's
steady clock. So each stage contains the way over the mesh to the next reader, and the last one that to the base, which
receives the command as the recorder does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from apps.captures.recorded import Once, steps_of
from cocoro.arrays import FloatArray
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.capture.types import MessageHead
from cocoro.messages import Detections, StepRecord
from cocoro.topics import BASE_COMMAND, DETECTIONS, FRAME

PLANNER = "planning"
MS = 1e6

Number = tuple[int, int]
"""Incarnation and sequence number of a message of one key."""


class Stage(msgspec.Struct, kw_only=True):
    """Times of one stage, ms."""

    name: str
    median_ms: float
    p99_ms: float
    worst_ms: float


class Latency(msgspec.Struct, kw_only=True):
    """The result for one run."""

    frames: int = 0
    """Frames in the captures."""
    seen: int = 0
    """Frames that became detections. The others came while perception was busy with an earlier one."""
    used: int = 0
    """Frames whose detections were consumed by a step that commanded the wheels. The robot stood still at the others,
    or a newer frame's detections took their place."""
    stages: tuple[Stage, ...] = ()
    """Perception, planning, and both together; empty when no frame was used."""


class _Used(NamedTuple):
    """Log times of one frame and of what it led to."""

    frame_ns: int
    detections_ns: int
    command_ns: int


def latency(captures: Sequence[Capture]) -> Latency:
    """The times from frame to wheel command in the captures of one run, in order.

    Raises CaptureError when they lack what links a frame to a command: frames, detections, or the planner's steps.
    """
    frames: dict[Number, int] = {}
    detections: dict[Number, tuple[Number, int]] = {}
    commands: dict[Number, int] = {}
    steps = [step for _, step in steps_of(captures, PLANNER)]
    heads = msgspec.msgpack.Decoder(MessageHead)
    whole = msgspec.msgpack.Decoder(Detections)
    wanted = (FRAME, DETECTIONS, BASE_COMMAND)
    once = Once()
    for capture in captures:
        for record in once.each(capture.messages(*(f"{capture.robot}/{topic.name}" for topic in wanted))):
            topic = record.key.removeprefix(f"{capture.robot}/")
            try:
                if topic == DETECTIONS.name:
                    found = whole.decode(record.payload)
                    of_frame = (found.frame_incarnation, found.frame_seq)
                    detections.setdefault((found.incarnation, found.seq), (of_frame, record.log_ns))
                else:
                    head = heads.decode(record.payload)
                    times = frames if topic == FRAME.name else commands
                    times.setdefault((head.incarnation, head.seq), record.log_ns)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                continue  # readers reject it, too
    for name, messages in ((FRAME.name, frames), (DETECTIONS.name, detections)):
        if not messages:
            raise CaptureError(f"{captures[0].path}: it has no {name}")
    used = _used(frames, detections, commands, steps)
    seen = {frame for frame, _ in detections.values()}
    return Latency(frames=len(frames), seen=len(seen & frames.keys()), used=len(used), stages=_stages(used))


def _used(
    frames: dict[Number, int],
    detections: dict[Number, tuple[Number, int]],
    commands: dict[Number, int],
    steps: Sequence[StepRecord],
) -> list[_Used]:
    used = []
    for step in steps:
        consumed = [detections.get(number[1:]) for number in step.consumed if number[0] == DETECTIONS.name]
        produced = [commands.get(number[1:]) for number in step.produced if number[0] == BASE_COMMAND.name]
        newest = consumed[-1] if consumed else None
        if newest is None or not produced or produced[0] is None or newest[0] not in frames:
            continue
        used.append(_Used(frames[newest[0]], newest[1], produced[0]))
    return used


def _stages(used: Sequence[_Used]) -> tuple[Stage, ...]:
    if not used:
        return ()
    times_ns = np.array(used, dtype=np.int64)
    frame, detected, command = times_ns.T
    stages = {"perception": detected - frame, "planning": command - detected, "pixel to motor": command - frame}
    return tuple(_stage(name, taken_ns / MS) for name, taken_ns in stages.items())


def _stage(name: str, taken_ms: FloatArray) -> Stage:
    median, p99 = np.percentile(taken_ms, (50, 99))
    return Stage(name=name, median_ms=float(median), p99_ms=float(p99), worst_ms=float(taken_ms.max()))
