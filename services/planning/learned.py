"""The body model that the planner reaches and drives with: the nominal one, or the learned one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import exp
from pathlib import Path

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.errors import ConfigError
from cocoro.learning import model as models
from cocoro.learning.handmap import HandMap, NominalModel
from cocoro.learning.model import BodyModel
from cocoro.robot import Robot
from services.planning.config import HandSightConfig, PlanningConfig
from services.planning.head import CameraTilt
from services.planning.reach import HandModel
from services.planning.reachability import ReachMesh
from services.planning.state_estimator import PostureSighting
from services.planning.teaching import Teacher

USUAL_M = 0.005
"""Error of a map whose model has no score."""
NOTHING_LEARNED = "rigid body: nothing learned"


class LearnedHand:
    """The pads' centre by the learned map: its nominal position, moved as the map moves the marker.

    The map gives positions of the marker only, so the hand's direction stays nominal. See `HandModel` for the methods.
    """

    def __init__(self, robot: Robot, learned: HandMap) -> None:
        self._drawn = robot.chain(robot.arm.tip)
        self._map = learned

    def pose(self, angles: Mapping[str, float]) -> FloatArray:
        pose = self._drawn.pose(angles)
        pose[:3, 3] += self._offset(angles)
        return pose

    def position(self, angles: Mapping[str, float]) -> FloatArray:
        return np.asarray(self._drawn.position(angles) + self._offset(angles))

    def jacobian(self, angles: Mapping[str, float], joints: Iterable[str]) -> FloatArray:
        """Jacobian (6, n), as `Chain.jacobian`, for the n joints of the arm in their order."""
        jac = self._drawn.jacobian(angles, joints)
        at = self._map.nominal.posture(angles)
        if self._map.over_nominal and self._map.coordinates == "cartesian":
            jac[:3] += self._map.network.jacobian(at)
        else:
            jac[:3] += self._map.jacobian(at) - self._map.nominal.jacobian(at)
        return jac

    def _offset(self, angles: Mapping[str, float]) -> FloatArray:
        at = self._map.nominal.posture(angles)
        if self._map.over_nominal and self._map.coordinates == "cartesian":
            return self._map.network.at(at)
        return np.asarray(self._map.at(at) - self._map.nominal.at(at))


class SeenHand:
    """The computed hand with a slow correction towards where its marker is seen. See `HandModel` for the methods.

    The paper's DIRECT switches between the seen and the computed hand. The correction instead avoids jumps when the
    marker comes into view or is hidden, however far the two are apart. Without new sightings it decays.
    """

    def __init__(self, felt: HandModel, marker: HandMap | NominalModel, config: HandSightConfig) -> None:
        self._felt = felt
        self._marker = marker
        self._nominal = marker.nominal if isinstance(marker, HandMap) else marker
        self._config = config
        self._correction = np.zeros(3)
        """Added to the computed hand position, (3,), metres."""
        self._wanted = np.zeros(3)
        self._now_ns: int | None = None
        self._seen_ns: int | None = None

    def pose(self, angles: Mapping[str, float]) -> FloatArray:
        pose = self._felt.pose(angles)
        pose[:3, 3] += self._correction
        return pose

    def position(self, angles: Mapping[str, float]) -> FloatArray:
        return np.asarray(self._felt.position(angles) + self._correction)

    def jacobian(self, angles: Mapping[str, float], joints: Iterable[str]) -> FloatArray:
        return self._felt.jacobian(angles, joints)

    def seen(self, now_ns: int) -> bool:
        """Whether the hand was seen within `lately_s`."""
        return self._seen_ns is not None and now_ns - self._seen_ns < self._config.lately_s * NS

    def step(self, sightings: Iterable[PostureSighting], now_ns: int) -> None:
        """Enter the marker's sightings of this planner step, and move the correction."""
        config = self._config
        dt_s = 0.0 if self._now_ns is None else min(max((now_ns - self._now_ns) / NS, 0.0), 0.1)
        self._now_ns = now_ns
        for sighting in sightings:
            if not self._nominal.holds_at(sighting.angles_rad, config.roll_rad):
                continue
            gap = np.array(sighting.position_m) - self._marker.at(self._nominal.posture(sighting.angles_rad))
            if float(np.linalg.norm(gap)) <= config.wild_m:
                self._wanted = gap
                self._seen_ns = sighting.stamp_ns
        if not self.seen(now_ns):
            self._wanted = self._wanted * exp(-dt_s / config.fade_s)
        move = (self._wanted - self._correction) * (1.0 - exp(-dt_s / config.follow_s))
        size_m, most_m = float(np.linalg.norm(move)), config.speed_mps * dt_s
        self._correction = self._correction + (move if size_m <= most_m else move * (most_m / size_m))


class Learned:
    """The learned parts of the body model in use, and their description for the status."""

    def __init__(self, robot: Robot, config: PlanningConfig) -> None:
        self._robot = robot
        self._config = config
        self._text = NOTHING_LEARNED
        self._refusal = ""
        self.separation_m: float | None = None
        self.camera_tilt = CameraTilt(robot)
        self.hand: SeenHand | None = None
        """None: the nominal model, uncorrected by sight."""
        self.map: HandMap | None = None
        self.mesh: ReachMesh | None = None
        """Mesh of the positions where the hand was seen; None where the arm was not learned."""
        self._teacher: Teacher | None = None
        self._use(None)

    @property
    def text(self) -> str:
        """The text for the status: the model in use, and the last refusal."""
        text = f"{self._text}; {self._teacher.text}" if self._teacher is not None else self._text
        return f"{text} ({self._refusal})" if self._refusal else text

    def step(self, sightings: Sequence[PostureSighting], now_ns: int) -> None:
        """Enter the marker's sightings of this planner step."""
        if self._teacher is not None:
            self._teacher.step(sightings)
        if self.hand is not None:
            self.hand.step(sightings, now_ns)

    def offset_m(self, angles: Mapping[str, float]) -> FloatArray | None:
        """Seen less nominal position of the marker, (3,), metres; None where the arm was not learned."""
        if self.map is None:
            return None
        at = self.map.nominal.posture(angles)
        return np.asarray(self.map.at(at) - self.map.nominal.at(at))

    def rest(self) -> None:
        """Do work that takes long; called while the robot is idle."""
        if self._teacher is not None:
            self._teacher.rest()

    def load(self, path: str) -> None:
        """Take over the model in a file. A refused one changes only the text."""
        try:
            self._take(models.load(Path(path), self._robot))
        except ConfigError as error:
            self._refusal = str(error)

    def take(self, content: bytes) -> None:
        """Take over a model that came by the mesh, like `load`."""
        try:
            self._take(models.decode(content, self._robot, "from the mesh"))
        except ConfigError as error:
            self._refusal = str(error)

    def _take(self, model: BodyModel) -> None:
        self._refusal = ""
        self.separation_m = model.wheels.separation_m if model.wheels is not None else None
        self.camera_tilt = CameraTilt(self._robot, model.wheels.eye_tilt_rad if model.wheels is not None else 0.0)
        arm = model.arm if self._config.reach == "learned" else None
        self._teacher, self.mesh = None, None
        learned = models.hand_map(arm, self._robot) if arm is not None else None
        if arm is not None and learned is not None:
            self.mesh = ReachMesh(np.array(arm.seen_m))
            if self._config.adapt:
                usual_m = arm.training.scores.get("held_out_rms_m", USUAL_M)
                self._teacher = Teacher(learned, usual_m, self.mesh)
                learned = self._teacher.map
        self._use(learned)
        said = "rigid body: asked for" if self._config.reach == "rigid" else "rigid body: no arm in the model"
        if arm is not None:
            error_m = arm.training.scores.get("held_out_rms_m", float("nan"))
            said = f"learned from {arm.training.samples} samples, {1000 * error_m:.1f} mm off where they are held out"
        wheels = f"; wheels {1000 * self.separation_m:.1f} mm apart" if self.separation_m is not None else ""
        self._text = said + wheels

    def _use(self, learned: HandMap | None) -> None:
        self.map = learned
        if learned is not None:
            self.hand = SeenHand(LearnedHand(self._robot, learned), learned, self._config.sight)
        elif self._config.see_hand and self._robot.marker is not None:
            self.hand = SeenHand(self._robot.chain(self._robot.arm.tip), NominalModel(self._robot), self._config.sight)
        else:
            self.hand = None
