"""The request of a rehearsal: one task, and the simulated robot and scene that it is tried in."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from cocoro.robot_files import objects_beside, scene_beside
from services.executive.tasks import TASKS
from sim.kinds import BodyKind, Sensors
from sim.scene_names import DEFAULT


class RehearsalRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Two rehearsals of one request give equal results, except for the wall time."""

    task: Any
    """A `cocoro.tasks.Task`, or the map that it travels as."""
    wait_s: Annotated[float, Meta(ge=0, le=3600)] = 0.0
    """Time that the world runs before the first task is asked for, simulated seconds."""
    then: tuple[Any, ...] = ()
    """Further tasks, as `task`, one after the other. The first task that fails is the last."""
    samples: str | None = None
    """File that the reported samples are appended to. The task continues after the last sample in it."""
    scene: str = DEFAULT
    """A scene's name, or the path of a scene file. Of a robot that has its own scene of that name, it is that."""
    seed: Annotated[int, Meta(ge=0)] = 0
    sensors: Sensors = "ideal"
    body: BodyKind = "nominal"
    """Worn: lengths, joint zeros, camera, marker and wheels differ from the nominal model, drawn by the seed."""
    description: str | None = None
    """File of a robot description in place of the Calliope's, or the name of a robot that the project ships."""
    measured: str | None = None
    """File of the values measured on one robot; they replace the description's."""
    model: str | None = None
    """File of the learned model."""
    reach: Literal["learned", "rigid"] = "learned"
    """Rigid: reach without the learned model of the arm."""
    see_hand: bool = False
    """Correct the rigid body's reach by where the hand is seen."""
    adapt: bool = False
    """Keep training the learned model of the arm at work."""
    bend_s: Annotated[float, Meta(ge=0)] | None = None
    """Time at which the forearm is bent, by 3 cm at the hand."""
    latency: dict[str, Annotated[float, Meta(ge=0, le=60)]] = {}
    """Seconds added to every step of a service, by its name."""
    lockstep: bool = False
    """One serial cycle over perception and planning, as in the paper: the baseline to compare with."""
    width: Annotated[int, Meta(ge=16, le=4096)] = 640
    height: Annotated[int, Meta(ge=16, le=4096)] = 480
    frame_rate_hz: Annotated[float, Meta(gt=0, le=120)] = 30.0
    camera_process: bool = False
    """Draw the camera's pictures in a process of its own, on another core. The result is the same."""
    timeout_s: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """Time limit of the task, simulated seconds; None: the task's own."""
    picture: str | None = None
    """File for the last picture of the task's snapshot phase (PNG)."""
    objects: str | None = None
    """File of known objects in place of the robot's own, or the project's."""
    seen_within_m: Annotated[float, Meta(gt=0, le=3)] | None = None
    """Judge by the truth which floor the camera saw within this distance of where the tasks began."""
    trace: bool = False
    """Add to the result how everything moved, by the truth and by the robot's own estimate."""
    record: str | None = None
    """File to record everything to (MCAP), steps of perception and planning included."""

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "task", TASKS.read(self.task))
        msgspec.structs.force_setattr(self, "then", tuple(TASKS.read(task) for task in self.then))
        if self.objects is None and (objects := objects_beside(self.description)) is not None:
            msgspec.structs.force_setattr(self, "objects", str(objects))
        if (scene := scene_beside(self.description, self.scene)) is not None:
            msgspec.structs.force_setattr(self, "scene", str(scene))
