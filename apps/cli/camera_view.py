"""Takes a view of a new object, from a picture file or a robot's camera, and draws what was learned of it."""

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
from apps.cli.link import PERCEPTION, MeshLink, joined
from apps.cli.options import RobotChoice
from apps.pictures import colour_of, describe, draw
from cocoro.arrays import ImageArray
from cocoro.component import load as load_component
from cocoro.core import Sample
from cocoro.errors import ConfigError, MeshError
from cocoro.messages import Detections, Frame, Message, ServoState
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from deploy import processes
from deploy.survey import within
from services.kinect.picture import load

FRAME_S = 5.0
"""Longest wait for a frame and the head's angles."""
STILL_RAD = 0.01
"""Largest change between two readings of the head; with more, the picture is blurred and the pose uncertain."""
MS = 1_000_000
OWN, OTHER, OUTLINE = (0, 255, 120), (255, 0, 60), (255, 255, 255)


@dataclass(frozen=True)
class CameraView:
    """One view of the camera, and what is known of the robot at that time."""

    object_view: ObjectView
    frame: Frame
    head_rad: dict[str, float] | None
    """Angles of the head's joints when the frame was taken; None for a picture file."""
    catalogue: Path | None
    """The file of known objects that the running robot was started with, if any."""


def of_picture(path: Path, robot: Robot) -> CameraView:
    """A picture file, assumed to be taken by the robot's camera. Raises ConfigError for an unreadable picture."""
    if not path.is_file():
        raise ConfigError(f"there is no picture {path}; --from takes a file, or `live`")
    image = load(path)
    if image is None:
        raise ConfigError(f"{path} is not a readable picture (PNG, JPEG)")
    colour = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    height, width = colour.shape[:2]
    if max(height, width) > 4096:
        raise ConfigError(f"{path} has {width} x {height} pixels; at most 4096 on each side are allowed")
    frame = Frame(width=width, height=height, colour=colour.reshape(-1).data, depth=memoryview(b""), stamp_ns=MS)
    return CameraView(ObjectView(colour, robot), frame, None, None)


async def of_robot(choice: RobotChoice) -> CameraView:
    """The robot's newest view. Raises MeshError when the robot is not there, or publishes no frames or head angles."""
    async with joined(choice, frames=True, best=True) as link:
        robot, catalogue = await link.described(), link.catalogue_file()
        frame, head = await _frame(link, robot.camera_chain.joints)
    pose = robot.camera_chain.pose(head)
    raw_depth = None
    if frame.has_depth:
        raw_depth = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)
    object_view = ObjectView(colour_of(frame), robot, raw_depth, pose)
    return CameraView(object_view, frame, head, catalogue)


async def _frame(link: MeshLink, joints: tuple[str, ...]) -> tuple[Frame, dict[str, float]]:
    """A frame and the head's angles, rad, at its time; preferably one for which the head stood still."""
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
        missing = "frame from the camera" if not frames else "angles of the head from the arm's servos"
        raise MeshError(f"no {missing} within {FRAME_S:g} s: see `cocoro status`")
    return pair


def _with_head(
    frame: Frame, states: deque[ServoState], joints: tuple[str, ...], still: bool
) -> tuple[Frame, dict[str, float]] | None:
    """The frame with the head's angles interpolated at its stamp; None when a state around it is missing."""
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


# --- the preview -----------------------------------------------------------------------------------


def preview(view: CameraView, learned: LearnedObject, catalogue: Path) -> tuple[ImageArray, list[str]]:
    """A picture and descriptions of what perception would detect with this catalogue.

    The picture, RGB, (height, width, 3), has the object's outline, the detections, and a tint on every pixel of its
    colours: green on the object, red elsewhere.
    """
    image = view.object_view.colour.copy()
    own = learned.region.mask > 0
    for place, tint in ((learned.matched & own, OWN), (learned.matched & ~own, OTHER)):
        image[place] = (0.5 * image[place] + 0.5 * np.array(tint)).astype(np.uint8)
    cv2.drawContours(image, outline_of(learned.region), -1, OUTLINE, 1)
    seen = _perceived(view, catalogue)
    tinted = msgspec.structs.replace(view.frame, colour=np.ascontiguousarray(image).reshape(-1).data)
    drawn = draw(tinted, seen, Catalogue.load(catalogue))
    _put_close_up(drawn, view.object_view.colour, learned)
    return drawn, [describe(one) for one in seen.detections]


def _put_close_up(image: ImageArray, colour: ImageArray, learned: LearnedObject) -> None:
    """Draws the object enlarged with its outline into the corner of the picture that is furthest from it."""
    left, top, right, bottom = learned.region.box
    height, width = image.shape[:2]
    spare = max(right - left, bottom - top) // 3 + 3
    crop = slice(max(top - spare, 0), bottom + spare), slice(max(left - spare, 0), right + spare)
    rows, columns = colour[crop].shape[:2]
    factor = min(0.4 * height / rows, 0.4 * width / columns, 12.0)
    if factor < 1.5:  # the object is large enough
        return
    size = round(columns * factor), round(rows * factor)
    large = np.asarray(cv2.resize(colour[crop], size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    mask = cv2.resize(learned.region.mask[crop], size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(large, outlines, -1, OUTLINE, 1)
    x = 0 if (left + right) > width else width - size[0]
    y = 0 if (top + bottom) > height else height - size[1]
    image[y : y + size[1], x : x + size[0]] = large
    cv2.rectangle(image, (x, y), (x + size[0] - 1, y + size[1] - 1), OUTLINE, 1)


def _perceived(view: CameraView, catalogue: Path) -> Detections:
    """Detections of the robot's perception in the frame, with this catalogue."""
    component = load_component(processes.named(PERCEPTION))
    assert component.core is not None
    core = component.core(view.object_view.robot, msgspec.convert({"objects": str(catalogue)}, component.config))
    stamp_ns = view.frame.stamp_ns
    samples = [Sample(FRAME, view.frame)]
    if view.head_rad is not None:
        for number, stamp in enumerate((stamp_ns - MS, stamp_ns + MS)):
            samples.append(Sample(ARM_STATE, _head_state(view.head_rad, stamp, number)))
    for now_ns in (stamp_ns + MS, stamp_ns + 400 * MS):  # without the head's angles perception waits for them first
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
