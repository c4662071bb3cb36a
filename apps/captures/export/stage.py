"""The stage of a simulated run, from what its simulator said of itself: in a capture, or on the mesh."""

from __future__ import annotations

import base64
import json

from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.errors import ConfigError
from cocoro.messages import AboutReply
from cocoro.robot import Robot
from sim.outside import OutsideStage, stage_of

SIMULATORS = ("sim.service", "sim.wire.service")
"""The modules that publish the truth."""


def recorded_stage(capture: Capture) -> OutsideStage:
    """The stage of a capture. Raises CaptureError for a capture of no simulated robot, or of one that cannot be made
    again."""
    for name, entries in capture.metadata.items():
        if name.startswith("service/") and entries.get("module") in SIMULATORS:
            try:
                files = {file["field"]: base64.b64decode(file["content"]) for file in json.loads(entries["files"])}
                robot = Robot.from_data(json.loads(entries["description"]), "the recorded robot description")
                return stage_of(robot, json.loads(entries["config"]), files)
            except (KeyError, TypeError, ValueError, ConfigError) as error:
                raise CaptureError(f"{capture.path}: its simulated world cannot be made again: {error}") from error
    raise CaptureError(
        f"{capture.path}: there is no view from outside: it is no capture of a simulated robot, or its simulator had "
        f"not stated its scene yet"
    )


def stated_stage(about: AboutReply) -> OutsideStage:
    """The stage of a simulator that runs. Raises ConfigError for one that cannot be made again."""
    robot = Robot.from_data(about.description, "the simulator's robot description")
    return stage_of(robot, about.config, {file.field: file.content for file in about.files})
