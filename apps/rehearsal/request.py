"""What `cocoro rehearse` asks for: one task, in one process, in virtual time."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.messages import TaskName

Sensors = Literal["ideal", "real"]
Body = Literal["nominal", "worn"]


class RehearsalRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Two rehearsals of one request give equal results but for the wall time."""

    task: TaskName
    label: str = ""
    bring: bool = False
    """Fetch: bring it back to where the task began."""
    for_s: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """Follow: for so long."""
    distance_m: Annotated[float, Meta(ge=0, le=5)] = 0.2
    """Go-to: from the robot's centre to the target's nearest edge, over the floor."""
    then: tuple[str, ...] = ()
    """The same task again, one after the other, with each of these labels; the first that fails is the last."""
    first: Annotated[int, Meta(ge=0)] = 0
    """Babbling: the number of its first draw."""
    count: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    """Babbling: how many samples or trials."""
    samples: str | None = None
    """Babbling: the file that they are appended to; with samples in it, babbling goes on where they end."""
    scene: str = "paper"
    """A scene's name, or the path of a scene file."""
    seed: Annotated[int, Meta(ge=0)] = 0
    sensors: Sensors = "ideal"
    body: Body = "nominal"
    """Worn: lengths, joint zeros, camera, marker and wheels are off what the drawing says, as the seed says."""
    description: str | None = None
    """A robot description instead of the Calliope's."""
    measured: str | None = None
    """A robot's own file with the values that were measured on it; they replace the description's."""
    model: str | None = None
    """The file of what was learned of the body."""
    reach: Literal["learned", "rigid"] = "learned"
    """Rigid: whatever was learned of the arm."""
    see_hand: bool = False
    """Reaching with the rigid body, bring it to where the hand is seen."""
    adapt: bool = False
    """What was learned of the arm goes on being taught at work."""
    bend_s: Annotated[float, Meta(ge=0)] | None = None
    """When somebody bends the forearm, by 3 cm at the hand."""
    latency: dict[str, Annotated[float, Meta(ge=0, le=60)]] = {}
    """Seconds that are added to every step of a service, by the service's name."""
    lockstep: bool = False
    """One serial cycle over all components, as the paper had it: the baseline to compare with."""
    width: Annotated[int, Meta(ge=16, le=4096)] = 640
    height: Annotated[int, Meta(ge=16, le=4096)] = 480
    frame_rate_hz: Annotated[float, Meta(gt=0, le=120)] = 30.0
    timeout_s: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """Of the task, simulated seconds; None is the executive's own limit."""
    picture: str | None = None
    """Where to write what the robot saw at the grasp (PNG)."""
    objects: str | None = None
    """A file of known objects instead of the project's own."""
    trace: bool = False
    """Have in the result how everything moved, by the truth and by the robot's own belief."""
    record: str | None = None
    """Where to record everything (MCAP), the steps of perception and planning too."""
