"""What a page may send: one type for each `do`. A message that is none of these ends its connection."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from cocoro.messages import Count, FiniteVec2, Motion
from services.cockpit.access import Doing

Id = int | Annotated[str, Meta(max_length=64)]
"""Chosen by the page; the answer repeats it."""
_Pixel = Annotated[float, Meta(ge=-1, le=4096)]
_Side = Annotated[int, Meta(ge=1, le=4096)]


class Order(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", forbid_unknown_fields=True):
    """Base of all messages of a page."""


class Run(Order, frozen=True, kw_only=True, tag="run"):
    """Start a task."""

    id: Id
    task: dict[str, Any]
    instead: bool = False
    """End the running task for it."""


class Cancel(Order, frozen=True, kw_only=True, tag="cancel"):
    """End the running task."""

    id: Id


class Stop(Order, frozen=True, kw_only=True, tag="stop"):
    """Emergency stop."""

    id: Id = 0


class Reset(Order, frozen=True, kw_only=True, tag="reset"):
    """Release the emergency stop."""

    id: Id


class PictureClick(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A place in a picture, in that picture's pixels."""

    stamp_ns: int
    u: _Pixel
    v: _Pixel
    width: _Side
    height: _Side


class What(Order, frozen=True, kw_only=True, tag="what"):
    """What is there, in the picture or on the map (odometry frame, m)."""

    id: Id
    picture: PictureClick | None = None
    map: FiniteVec2 | None = None


class BeginDrive(Order, frozen=True, kw_only=True, tag="begin-drive"):
    """Take the robot, to drive it by hand."""

    id: Id
    instead: bool = False
    """End the running task for it."""


class Drive(Order, frozen=True, kw_only=True, tag="drive"):
    """The motion that is wanted now; it counts only with a tick that is fresh on the robot."""

    tick: Count = 0
    motion: Motion = Motion()


class EndDrive(Order, frozen=True, kw_only=True, tag="end-drive"):
    """Let go of the robot."""

    id: Id


class Seen(Order, frozen=True, kw_only=True, tag="seen"):
    """A picture was shown."""

    stamp_ns: int


class Log(Order, frozen=True, kw_only=True, tag="log"):
    """Whether log lines are wanted."""

    on: bool


class Look(Order, frozen=True, kw_only=True, tag="pictures"):
    """Whether pictures are wanted."""

    on: bool


class Seek(Order, frozen=True, kw_only=True, tag="seek"):
    """Go to a time of the capture that is played."""

    at_s: Annotated[float, Meta(ge=0)]


class Pause(Order, frozen=True, kw_only=True, tag="pause"):
    """Hold the playing, or go on."""

    on: bool


class Speed(Order, frozen=True, kw_only=True, tag="speed"):
    """How fast a capture is played."""

    x: Annotated[float, Meta(ge=0.1, le=16)]


LiveOrder = Run | Cancel | Stop | Reset | What | BeginDrive | Drive | EndDrive | Seen | Log | Look
PlayOrder = Stop | What | Seen | Look | Seek | Pause | Speed

RIGHTS: dict[type[Order], Doing] = {
    Stop: "stop",
    **dict.fromkeys((Run, Cancel, Reset, BeginDrive, Drive, EndDrive), "operate"),
}
"""What an order needs; `look` where it is not listed."""


def live_decoder() -> msgspec.json.Decoder[LiveOrder]:
    """Reads the messages of a live page."""
    return msgspec.json.Decoder(LiveOrder)


def play_decoder() -> msgspec.json.Decoder[PlayOrder]:
    """Reads the messages of a page that plays a capture."""
    return msgspec.json.Decoder(PlayOrder)
