"""The planner's state estimate: states read as history, never older than their topic's age, and the target memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from itertools import compress
from math import hypot, inf
from typing import Any, NamedTuple

import msgspec
import numpy as np

from cocoro import topics
from cocoro.arrays import FloatArray
from cocoro.clock import NS, is_fresh
from cocoro.frames import Pose2
from cocoro.history import History
from cocoro.messages import (
    BaseState,
    Detection,
    Detections,
    Intent,
    Message,
    Motion,
    Obstacles,
    PolicyActions,
    ServoState,
)
from cocoro.messages.driving import HOLD_S
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import Topic
from cocoro.units import Vec3
from services.planning.config import PlanningConfig
from services.planning.floor_map import Solid, inside
from services.planning.gaze import gaze_of
from services.planning.head import CameraTilt
from services.planning.memory import TargetMemory
from services.planning.own_arm import SEEN_WHOLE, OwnArm
from services.planning.perception_watch import PerceptionWatch
from services.planning.pose_matching import PoseMatching
from services.planning.posture_history import PostureHistory
from services.planning.seen_floor import SeenFloor
from services.planning.seen_through import VIEW_BYTES, DepthView
from services.planning.surroundings import OBJECT_M, Surroundings
from services.planning.turning import Turning

_WAIT_FOR_ODOMETRY_NS = NS // 5
_SLOW_S = 0.2
_JUST_SEEN_S = 0.5
"""An object that a frame does not show, but which was seen so shortly before it, is still in it."""
_STEADY_RADPS = 1.0
"""A camera that turns faster does not correct the body's pose."""
_ARM_M = 0.75
"""As far from the body's centre an arm reaches. So near nothing that is seen counts while it is not known where the arm
was: it would stay on the map as an obstacle in its own way."""
_GLIMPSE_NS = NS // 20
"""Time over which the camera's turn is measured."""
FLOOR_M, FLOOR_PER_M = 0.040, 0.012
"""Height below which a point counts as floor for a tilted camera, and its growth per metre of distance: more than
perception's limit, because a tilted camera is likely to be rolled a little, too."""


class PostureSighting(NamedTuple):
    """A detection without doubt, with the joint angles at its frame's stamp."""

    label: str
    stamp_ns: int
    position_m: Vec3
    area_px: int
    angles_rad: dict[str, float]
    """By joint, all of them."""


class StateEstimator:
    """Takes every input of the planner and answers queries by time."""

    def __init__(self, config: PlanningConfig, robot: Robot, catalogue: Catalogue | None = None) -> None:
        """`catalogue`: the known objects, for their sizes."""
        self._robot = robot
        self._known = {item.label: item for item in catalogue.targets} if catalogue is not None else {}
        self._joints = tuple(robot.joints)
        self.memory = TargetMemory(config.memory)
        self.base: BaseState | None = None
        self.arm: ServoState | None = None
        self.hand: ServoState | None = None
        self.intent: Intent | None = None
        self.proposed: PolicyActions | None = None
        """The newest chunk of a learned policy."""
        self.unlocalised: dict[str, tuple[int, str]] = {}
        """By label, the stamp and note of its newest detection without a position."""
        self._odometry = History(3, angular=(2,))
        self._postures = PostureHistory(robot.joints, round(config.odometry_gap_s * NS))
        self._gap_ns = round(config.odometry_gap_s * NS)
        self.around = Surroundings(config.marker, {label: item.planar_radius_m for label, item in self._known.items()})
        self._gaze = gaze_of(robot, config.head)
        self.own_arm = OwnArm(robot, self._gaze, self._known)
        self.seen = SeenFloor(config.search, robot, self._gaze)
        self._waiting: deque[Detections] = deque(maxlen=8)
        self._floors: deque[Obstacles] = deque(maxlen=4)
        self._localised_ns = 0
        """Stamp of the newest frame whose detections are in the memory."""
        self._in_frames: deque[tuple[int, tuple[Solid, ...]]] = deque(maxlen=8)
        """Known objects by the stamp of the frame that they were seen in."""
        self.sight_lag_s = 0.0
        """Smoothed age of a sighting when the next one arrives; small for a fast perception."""
        self.looked_ns: int | None = None
        """Stamp of the newest frame whose detections have arrived."""
        self._published_ns: dict[str, int] = {}
        """By topic, when its newest message was published."""
        self._sight = PerceptionWatch(robot.base.command_timeout_s, config.blind_periods)
        self.turning = Turning()
        self.matching = PoseMatching()
        self.camera_tilt: CameraTilt | None = None
        """The camera's learned tilt: points that a tilted camera sees above the floor may be floor."""
        self._watched = {config.marker}
        self._sightings: list[PostureSighting] = []

    def take(self, topic: Topic[Message], message: Message, now_ns: int) -> None:
        self._published_ns[topic.name] = min(message.stamp_ns, now_ns)
        if isinstance(message, BaseState):
            self.base = message
            resets, before = self._odometry.resets, self._odometry.newest
            self._odometry.add(message.stamp_ns, self.turning.pose(message), message.incarnation)
            newest = self._odometry.newest
            if self._odometry.resets != resets:
                # The base restarted with a new odometry frame; positions in the old frame are void.
                self.memory.clear()
                self.around.clear()
                self.seen.clear()
                self._floors.clear()
                self._waiting.clear()
                self._localised_ns = 0
                self.matching.clear()
                self.turning.constants = self.matching.constants
            elif before is not None and newest is not None:
                self.matching.moved(Pose2(*before[1].tolist()), Pose2(*newest[1].tolist()))
        elif isinstance(message, ServoState):
            self._postures.add(topic.name, message)
            if topic.name == topics.ARM_STATE.name:
                self.arm = message
            else:
                self.hand = message
        elif isinstance(message, Detections):
            self._waiting.append(message)
            self._sight.arrived(now_ns, message.stamp_ns)
            if self.looked_ns is not None and message.stamp_ns > self.looked_ns:
                lag_s = min(max((now_ns - self.looked_ns) / NS, 0.0), 5.0)
                self.sight_lag_s += (0.3 if self.sight_lag_s else 1.0) * (lag_s - self.sight_lag_s)
            self.looked_ns = message.stamp_ns
        elif isinstance(message, Obstacles):
            self._floors.append(message)
        elif isinstance(message, Intent):
            self.intent = message
        elif isinstance(message, PolicyActions):
            self.proposed = message

    @property
    def servo_restarts(self) -> int:
        """How often the service of arm or hand, or its clock, began anew."""
        return self._postures.restarts

    def localise(self, now_ns: int) -> None:
        """Enter detections whose odometry is known into the memory; others wait for 0.2 s."""
        self._sightings.clear()
        self.memory.sight_lag_s = self.sight_lag_s
        for _ in range(len(self._waiting)):
            detections = self._waiting.popleft()
            pose = self._odometry.at(detections.stamp_ns, self._gap_ns)
            if pose is not None:
                self._remember(detections, self.matching.place(Pose2(*pose.tolist())))
                if self.seen.running and self._turning_radps(detections.stamp_ns) < _STEADY_RADPS:
                    self._compare(detections, Pose2(*pose.tolist()))
            elif now_ns - detections.stamp_ns < _WAIT_FOR_ODOMETRY_NS:
                self._waiting.append(detections)

    def look_around(
        self, now_ns: int, own: Callable[[Mapping[str, float]], tuple[FloatArray, FloatArray]], *, on_way: bool = False
    ) -> None:
        """Enter floor observations whose odometry is known. `own`: the robot's hull by joint angles. `on_way`: a pose
        that a search has corrected is corrected further."""
        while self._floors:
            seen = self._floors[0]
            pose = self._odometry.at(seen.stamp_ns, self._gap_ns)
            early = pose is None or self._localised_ns < seen.stamp_ns
            if early and 0 <= now_ns - seen.stamp_ns < _WAIT_FOR_ODOMETRY_NS:
                return
            self._floors.popleft()
            if pose is not None and now_ns - seen.stamp_ns <= topics.OBSTACLES.max_age_s * NS:
                seen = self._standing(seen)
                angles = dict(self.angles()) | self._postures.near(seen.stamp_ns)
                view = DepthView(self._robot, seen.nearest, angles) if len(seen.nearest) == VIEW_BYTES else None
                known = self._solids(seen.stamp_ns)
                hull, odometry = own(angles), Pose2(*pose.tolist())
                if not self._postures.known(seen.stamp_ns):  # what is near may be the robot's own arm
                    hull = np.vstack([hull[0], np.zeros(3)]), np.append(hull[1], _ARM_M)
                turning_radps = self._turning_radps(seen.stamp_ns)
                correct = self.seen.running or (on_way and self.matching.shift is not None)
                if correct and turning_radps < _STEADY_RADPS:
                    self._match(seen, odometry, hull, self._gaze.on_body(angles)[0])
                body = self.matching.place(odometry)
                self.around.floor.enter(seen, body, hull, known, view)
                self.seen.enter(seen, body, turning_radps, self.matching.doubt_m)

    def _compare(self, detections: Detections, odometry: Pose2) -> None:
        """Correct the body's pose by the known objects that a search sees."""
        self.matching.follow(self.seen.task_id)
        for detection in detections.detections:
            label, place = detection.label, detection.position_m
            if place is not None and not detection.note and label in self._known and self.memory.sure(label):
                self.matching.sight(label, place[:2], odometry)
        self.turning.constants = self.matching.constants

    def _match(self, seen: Obstacles, odometry: Pose2, hull: tuple[FloatArray, FloatArray], pan_rad: float) -> None:
        """Correct the body's pose by what a search's scan shows."""
        self.matching.follow(self.seen.task_id)
        points = np.array(seen.points_m).reshape(-1, 3)
        others = points[~inside(points, *hull)]
        if self.matching.scan(others[:, :2], seen.origin_m, odometry, pan_rad):
            self.turning.constants = self.matching.constants

    def _turning_radps(self, stamp_ns: int) -> float:
        """The rate at which the camera turned before a time; infinite where that is not known."""
        before_ns = stamp_ns - _GLIMPSE_NS
        angles, before = self._postures.at(stamp_ns), self._postures.at(before_ns)
        pose, pose_before = (self._odometry.at(at_ns, self._gap_ns) for at_ns in (stamp_ns, before_ns))
        if angles is None or before is None or pose is None or pose_before is None:
            return inf
        (pan, tilt), (pan_before, tilt_before) = self._gaze.on_body(angles), self._gaze.on_body(before)
        turned = pan - pan_before + float(pose[2] - pose_before[2])
        return hypot(turned, tilt - tilt_before) * NS / _GLIMPSE_NS

    def _solids(self, stamp_ns: int) -> list[Solid]:
        """The known objects that a frame shows, and where those are that were seen shortly before it."""
        found = [solid for stamp, solids in self._in_frames if stamp == stamp_ns for solid in solids]
        for label, item in self._known.items():
            place = self.memory.place(label, stamp_ns, within_s=_JUST_SEEN_S)
            if place is not None:
                found.append(Solid(place, item.planar_radius_m, item.size_m[2]))
        return found

    def _standing(self, seen: Obstacles) -> Obstacles:
        """The obstacles without points that appear above the floor only because the camera is tilted."""
        if self.camera_tilt is None or self.camera_tilt.tilt_rad <= 0.0 or not seen.points_m:
            return seen
        points = np.array(seen.points_m)
        distance = np.hypot(points[:, 0] - seen.origin_m[0], points[:, 1] - seen.origin_m[1])
        stands = self.camera_tilt.heights(points) > FLOOR_M + FLOOR_PER_M * distance
        stand = stands.tolist()
        return msgspec.structs.replace(
            seen, points_m=tuple(compress(seen.points_m, stand)), lowest_m=tuple(compress(seen.lowest_m, stand))
        )

    def _remember(self, detections: Detections, body: Pose2) -> None:
        self._localised_ns = detections.stamp_ns
        solids, angles = [], self._postures.at(detections.stamp_ns)
        for detection in detections.detections:
            if detection.position_m is None:
                self.unlocalised[detection.label] = (detections.stamp_ns, detection.note)
                continue
            distance_m = float(np.linalg.norm(detection.position_m))
            place = np.array(body.apply(detection.position_m))
            doubtful = detection.note != ""
            if (
                angles is not None
                and self.memory.whole(detection.label) >= SEEN_WHOLE
                and self.own_arm.hides(detection.label, detection.position_m, angles)
            ):
                continue
            if detection.label in self._watched and not doubtful:
                self._keep_sighting(detection, detections.stamp_ns)
            self.memory.see(
                detection.label, place, distance_m, detections.stamp_ns, doubtful=doubtful, body=body,
                own_sigma_m=detection.sigma_m,
            )  # fmt: skip
            item = self._known.get(detection.label)
            if item is not None and self.memory.sure(detection.label):
                x, y, z = place.tolist()
                solids.append(Solid((x, y, z), item.planar_radius_m, item.size_m[2]))
        self._in_frames.append((detections.stamp_ns, tuple(solids)))

    def _keep_sighting(self, detection: Detection, stamp_ns: int) -> None:
        angles = self._postures.at(stamp_ns)
        if angles is not None and detection.position_m is not None:
            self._sightings.append(
                PostureSighting(detection.label, stamp_ns, detection.position_m, detection.area_px, angles)
            )

    def width_m(self, label: str) -> float:
        """Width of a known object; of an unknown one that of the cans."""
        item = self._known.get(label)
        return 2 * (item.planar_radius_m if item is not None else OBJECT_M)

    def watch(self, label: str) -> None:
        """Keep the unfiltered sightings of a label, too."""
        self._watched.add(label)

    def sightings_of(self, label: str) -> list[PostureSighting]:
        """The watched label's sightings of the current step, in order."""
        return [sighting for sighting in self._sightings if sighting.label == label]

    def body(self) -> Pose2 | None:
        """The body's newest pose in the odometry frame."""
        newest = self._odometry.newest
        return self.matching.place(Pose2(*newest[1].tolist())) if newest else None

    def missing(self, now_ns: int) -> str:
        """Name the state that is missing or too old to move; '' when all are fresh."""
        for topic, message in (
            (topics.BASE_STATE, self.base),
            (topics.ARM_STATE, self.arm),
            (topics.HAND_STATE, self.hand),
        ):
            if message is None:
                return f"no {topic.name} yet"
            if not is_fresh(message.stamp_ns, now_ns, topic.max_age_s):
                return f"{topic.name} is {(now_ns - message.stamp_ns) / NS:.2f} s old"
        joints = self.angles()
        lacking = [name for name in self._joints if name not in joints]
        return f"no angle of {lacking[0]}" if lacking else ""

    def latched(self) -> str:
        """Name the hardware that is stopped by the emergency stop; '' when none is."""
        for name, state in (("base", self.base), ("arm", self.arm), ("hand", self.hand)):
            if state is not None and state.latch != "released":
                return f"{name}: emergency stop {state.latch}"
        return ""

    def blind_s(self, now_ns: int) -> float | None:
        """Time, s, for which perception has been later than it may be; None while it is not."""
        return self._sight.blind_s(now_ns)

    @property
    def heard_ns(self) -> int | None:
        """When perception's last message arrived; None before the first."""
        return self._sight.arrived_ns

    @property
    def slow_sight(self) -> bool:
        """Whether perception is so slow that waiting for it costs more than acting on what is known."""
        return self.sight_lag_s > _SLOW_S

    def unseen_s(self, now_ns: int) -> float:
        """Time, s, since perception's last message arrived."""
        return self._sight.unheard_s(now_ns)

    def _age_s(self, topic: Topic[Any], now_ns: int) -> float:
        """Age, s, of a topic's newest message by its stamp, or by its arrival where the stamp is in the future."""
        published_ns = self._published_ns.get(topic.name)
        # A publication time in the future belongs to the clock's last epoch.
        return (now_ns - published_ns) / NS if published_ns is not None and published_ns <= now_ns else float("inf")

    def intent_age_s(self, now_ns: int) -> float:
        """Age, s, of the executive's last intent."""
        return self._age_s(topics.INTENT, now_ns)

    def oldest(self, now_ns: int, *, sight: bool) -> tuple[str, float]:
        """The publisher that driving depends on with the oldest last message, and that age, s; perception counts with
        `sight`."""
        ages = {"the executive": self.intent_age_s(now_ns)}
        for topic in (topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE):
            ages[topic.service] = self._age_s(topic, now_ns)
        if sight:
            ages["perception"] = self._sight.age_s(now_ns)
        who = max(ages, key=ages.__getitem__)
        return who, ages[who]

    def fresh_intent(self, now_ns: int) -> Intent | None:
        if self.intent is None or not is_fresh(self.intent.stamp_ns, now_ns, topics.INTENT.max_age_s):
            return None
        return self.intent

    def motion(self, now_ns: int) -> Motion | None:
        """What the operator's hand wants now; None when nothing of it counts any more."""
        intent = self.fresh_intent(now_ns)
        if intent is None or intent.motion is None:
            return None
        return intent.motion if now_ns < min(intent.motion_until_ns, intent.stamp_ns + round(HOLD_S * NS)) else None

    def angles(self) -> Mapping[str, float]:
        """Every joint's newest measured angle, rad."""
        angles: dict[str, float] = {}
        for state in (self.arm, self.hand):
            if state is not None:
                angles.update(zip(state.joints, state.position_rad, strict=True))
        return angles
