"""Worn bodies for the benches of learning: each babbles with its arm in virtual time, with real sensors."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from apps.learning import dataset, study
from apps.learning.dataset import HandRow
from apps.learning.lesson import sightings
from apps.learning.sightings import Sightings
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot
from services.executive.tasks import BabbleArmTask

SEEDS = (501, 502)
"""The bodies: the simulator draws their errors of making and wear from these seeds."""
FEW, MANY = 300, 1000
"""Sightings of a body in the short form and in the full one. The first are the same in both."""


def babble(seed: int, count: int, robot: Robot) -> Sightings:
    """The first `count` sightings of a body's babbling, without outliers. It takes about a minute for a thousand."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "arm.jsonl"
        request = RehearsalRequest(
            task=BabbleArmTask(count=count), samples=str(file), seed=seed, sensors="real", body="worn", width=320,
            height=240, frame_rate_hz=15.0,
        )  # fmt: skip
        rehearse(request)
        rows = dataset.read(file, HandRow, robot).rows[:count]
    return study.clean(sightings(rows), NominalModel(robot))
