"""Where a look at a new object comes from, and how what was learnt of it looks."""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from apps.appearance.learn import LearnedObject, ObjectView
from apps.appearance.size import outline_of
from apps.cli.link import Link, joined, within
from apps.cli.options import RobotChoice
from apps.pictures import colour_of, describe, draw
from cocoro.arrays import ImageArray
from cocoro.component import load as load_component
from cocoro.core import Sample
from cocoro.errors import ConfigError, MeshError
from cocoro.messages import Detections, Frame, Message, ServoState
from cocoro.objects import Catalogue
from cocoro.picture import load
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from deploy import processes

PERCEPTION = "perception"
"""The process whose core says what the robot would see: loaded by name, since the API knows no services."""
FRAME_S = 5.0
STILL_RAD = 0.01
"""Between two readings of the head; more, and the picture is blurred and the camera's pose doubtful."""
NO_DEPTH = 2047
MS = 1_000_000
OWN, OTHER, OUTLINE = (0, 255, 120), (255, 0, 60), (255, 255, 255)


@dataclass(frozen=True)
class CameraView:
    look: ObjectView
    frame: Frame
    head_rad: dict[str, float] | None
    """The neck's joints as the frame was taken; None for a picture."""
    catalogue: Path | None
    """The file of known objects that the robot which is up was started with, if it was with one."""


def of_picture(path: Path, robot: Robot) -> CameraView:
    """A picture file, taken to be the robot's camera's. Raises ConfigError when it is none."""
    if not path.is_file():
        raise ConfigError(f"there is no picture {path}; --from names a file, or says live")
    image = load(path)
    if image is None:
        raise ConfigError(f"{path} is no picture that can be read (PNG, JPEG)")
    colour = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    height, width = colour.shape[:2]
    if max(height, width) > 4096:
        raise ConfigError(f"{path} has {width} x {height} pixels; 4096 a side are the most")
    depth = np.full(height * width, NO_DEPTH, dtype="<u2")
    frame = Frame(
        width=width, height=height, colour=colour.reshape(-1).data, depth=depth.view(np.uint8).data, stamp_ns=MS
    )
    return CameraView(ObjectView(colour, robot), frame, None, None)


async def of_robot(where: RobotChoice) -> CameraView:
    """What a robot sees now. Raises MeshError when it is not there, or sends no frames."""
    async with joined(where, frames=True) as link:
        resolved = link.run_dir.resolved()
        named = resolved.get("objects") or resolved.get("service", {}).get(PERCEPTION, {}).get("objects")
        robot = link.described()
        frame, head = await _frame(link, robot.chain("camera").joints)
    pose = robot.chain("camera").pose(head)
    raw_depth = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)
    look = ObjectView(colour_of(frame), robot, raw_depth, pose)
    return CameraView(look, frame, head, Path(named) if named else None)


async def _frame(link: Link, joints: tuple[str, ...]) -> tuple[Frame, dict[str, float]]:
    """A frame and the head's angles as it was taken; when it can be had, one for which the head was still."""
    frames: deque[Frame] = deque(maxlen=30)
    states: deque[ServoState] = deque(maxlen=500)
    news = asyncio.Event()
    camera, servos = link.inbox(FRAME), link.inbox(ARM_STATE)

    def keep(kept: deque[Any], message: Message) -> None:
        kept.append(message)
        news.set()

    camera.add(lambda _key, frame: keep(frames, frame))
    servos.add(lambda _key, state: keep(states, state))

    def found(still: bool) -> tuple[Frame, dict[str, float]] | None:
        return next((pair for frame in reversed(frames) if (pair := _with_head(frame, states, joints, still))), None)

    try:
        await within(FRAME_S, lambda: found(still=True) is not None, news)
        pair = found(still=True) or found(still=False)
    finally:
        for topic in (FRAME, ARM_STATE):
            link.drop(topic)
    if pair is None:
        missing = "frame from the camera" if not frames else "word from the arm's servos about the head"
        raise MeshError(f"no {missing} within {FRAME_S:g} s: `cocoro status` tells more")
    return pair


def _with_head(
    frame: Frame, states: deque[ServoState], joints: tuple[str, ...], still: bool
) -> tuple[Frame, dict[str, float]] | None:
    """The head between the states around the frame's stamp."""
    before = next((state for state in reversed(states) if state.stamp_ns <= frame.stamp_ns), None)
    after = next((state for state in states if state.stamp_ns > frame.stamp_ns), None)
    if before is None or after is None:
        return None
    first, second = (dict(zip(state.joints, state.position_rad, strict=True)) for state in (before, after))
    if any(joint not in first or joint not in second for joint in joints):
        return None
    if still and any(abs(first[joint] - second[joint]) > STILL_RAD for joint in joints):
        return None
    share = (frame.stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return frame, {joint: first[joint] + share * (second[joint] - first[joint]) for joint in joints}


# --- what was learnt ------------------------------------------------------------------------------


def preview(sight: CameraView, learnt: LearnedObject, catalogue: Path) -> tuple[ImageArray, list[str]]:
    """The picture with the region outlined, every pixel of its colour tinted (green: the object's, red: others), and
    what perception itself would see in it with that catalogue; and that in words."""
    image = sight.look.colour.copy()
    own = learnt.region.mask > 0
    for where, tint in ((learnt.matched & own, OWN), (learnt.matched & ~own, OTHER)):
        image[where] = (0.5 * image[where] + 0.5 * np.array(tint)).astype(np.uint8)
    cv2.drawContours(image, outline_of(learnt.region), -1, OUTLINE, 1)
    seen = _perceived(sight, catalogue)
    tinted = msgspec.structs.replace(sight.frame, colour=np.ascontiguousarray(image).reshape(-1).data)
    drawn = draw(tinted, seen, Catalogue.load(catalogue))
    _put_close_up(drawn, sight.look.colour, learnt)
    return drawn, [describe(one) for one in seen.detections]


def _put_close_up(image: ImageArray, colour: ImageArray, learnt: LearnedObject) -> None:
    """The object as it is, with its outline, large, in the corner of the picture that is furthest from it."""
    left, top, right, bottom = learnt.region.box
    height, width = image.shape[:2]
    spare = max(right - left, bottom - top) // 3 + 3
    crop = slice(max(top - spare, 0), bottom + spare), slice(max(left - spare, 0), right + spare)
    rows, columns = colour[crop].shape[:2]
    factor = min(0.4 * height / rows, 0.4 * width / columns, 12.0)
    if factor < 1.5:  # it is large as it stands
        return
    size = round(columns * factor), round(rows * factor)
    large = np.asarray(cv2.resize(colour[crop], size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    mask = cv2.resize(learnt.region.mask[crop], size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(large, outlines, -1, OUTLINE, 1)
    x = 0 if (left + right) > width else width - size[0]
    y = 0 if (top + bottom) > height else height - size[1]
    image[y : y + size[1], x : x + size[0]] = large
    cv2.rectangle(image, (x, y), (x + size[0] - 1, y + size[1] - 1), OUTLINE, 1)


def _perceived(sight: CameraView, catalogue: Path) -> Detections:
    """What the robot's own perception makes of the frame."""
    component = load_component(processes.named(PERCEPTION))
    assert component.core is not None
    core = component.core(sight.look.robot, msgspec.convert({"objects": str(catalogue)}, component.config))
    stamp_ns = sight.frame.stamp_ns
    samples = [Sample(FRAME, sight.frame)]
    if sight.head_rad is not None:
        for number, stamp in enumerate((stamp_ns - MS, stamp_ns + MS)):
            samples.append(Sample(ARM_STATE, _head_state(sight.head_rad, stamp, number)))
    for now_ns in (stamp_ns + MS, stamp_ns + 400 * MS):  # without the head's angles it waits for them for a while
        for output in core.step(samples, now_ns):
            if isinstance(output.message, Detections):
                return output.message
        samples = []
    raise ConfigError("perception gave no detections for the picture")


def _head_state(angles: dict[str, float], stamp_ns: int, seq: int) -> ServoState:
    still = (0.0,) * len(angles)
    return ServoState(
        stamp_ns=stamp_ns, seq=seq, joints=tuple(angles), position_rad=tuple(angles.values()), speed_radps=still,
        load=still,
    )  # fmt: skip
