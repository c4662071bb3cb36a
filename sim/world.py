"""The simulated robot in its scene: physics, motors and body sensors. The caller steps it; it has no clock of its
own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.joints import GROUPS, KEEPS_GOAL, Group
from cocoro.messages import BaseCommand, BaseState, LatchState, ServoCommand, ServoState, TrueObject, Truth
from cocoro.robot import Robot
from sim.base import Bumper, MobileBase
from sim.body import CASTERS
from sim.bullet import Bullet
from sim.contacts import ContactPair, bumper, collisions, touching_pairs
from sim.kinds import Sensors
from sim.mechanism import JointReading, Mechanism
from sim.model import build_model
from sim.realism import REALISM, BodyRealism, Wander, Wear, wheel_scales
from sim.render.interface import Visual
from sim.scene import Light, Scene
from sim.seeds import stream
from sim.servos import Drive, SimServoGroup
from sim.stage import FLOOR, Stage

SOLVER_ITERATIONS = {"differential": 50, "omni": 150}
"""By kind of base. What the solver leaves undone turns a standing robot on three wheels alone: by 1.4 degrees a minute
with 50, by 0.2 with 150."""
SETTLE_S = 0.5
SENSE_HZ = 60.0
"""How often contacts are read and new errors of the body are drawn."""
CONTACT_MEMORY = 2
"""A contact counts when it was there at one of this many last readings: the solver sometimes drops one for a step."""


class WheelMotion(NamedTuple):
    """The base's present drive of its wheels."""

    speed_mps: float
    """Speed of the fastest wheel by the base's ramp."""
    no_command: bool
    """Whether the wheels are stopped because the last command has expired."""


class Motors(NamedTuple):
    """Drives and sensors of wheels and joints."""

    base: MobileBase
    groups: dict[Group, SimServoGroup]


def message_motors(robot: Robot, angles_rad: Mapping[str, float], realism: BodyRealism) -> Motors:
    """Motors that take commands as messages, as the hardware services do."""
    groups = {
        group: SimServoGroup(
            {joint: robot.joints[joint] for joint in robot.group_joints(group)},
            angles_rad,
            keeps_goal=group in KEEPS_GOAL,
            timeout_s=robot.networks[robot.line_of(group)].command_timeout_s,
            backlash_deg=realism.backlash_deg,
        )
        for group in GROUPS
    }
    return Motors(MobileBase(robot.base, exact=realism.exact_odometry), groups)


class World:
    """A PyBullet world with one robot in it. Deterministic: the same arguments and commands give the same states.

    As real hardware it starts with an unknown latch, and obeys after `set_latch("released")`. A context manager.
    """

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        *,
        seed: int = 0,
        sensors: Sensors = "ideal",
        physics_hz: int = 240,
        wear: Wear | None = None,
        motors: Callable[[Robot, Mapping[str, float], BodyRealism], Motors] = message_motors,
    ) -> None:
        """`robot` is the nominal description, which base and servos use; `wear` is the true body (None: the nominal
        one); `motors` makes the drives."""
        self.robot = robot
        self.scene = scene
        self._hz = physics_hz
        self._dt_s = 1.0 / physics_hz
        self._steps = 0
        self._sense_every = max(1, round(physics_hz / SENSE_HZ))
        realism = REALISM[sensors]
        self._bullet = Bullet()
        self._bullet.setGravity(0.0, 0.0, -9.81)
        self._bullet.setPhysicsEngineParameter(
            fixedTimeStep=self._dt_s,
            numSolverIterations=SOLVER_ITERATIONS[robot.base.kind],
            numSubSteps=0,
            deterministicOverlappingPairs=1,
        )
        self._stage = Stage(self._bullet, scene)
        self._wear = wear if wear is not None else Wear(robot)
        self._model = build_model(self._wear.robot)
        self._jaws = frozenset(robot.fingers)
        angles = dict.fromkeys(robot.joints, 0.0) | robot.poses["park"]
        self._mechanism = Mechanism(self._bullet, self._wear.robot, self._model, scene.robot, angles)
        self._mechanism.roll_on_floor_alone([body for name, body in self._stage.bodies.items() if name != FLOOR])
        self._names = {body: name for name, body in self._stage.bodies.items()}

        self._base, self._groups = motors(robot, angles, realism)
        servos = {joint: servo for group in self._groups.values() for joint, servo in group.servos.items()}
        self._servos = [servos[joint] for joint in self._mechanism.joints]
        self._driven: list[Drive | None] = [None] * len(self._servos)

        sense_s = self._sense_every * self._dt_s
        self._radii_m = tuple(self._model.body.wheels.values())
        wheels = len(self._radii_m)
        self._wheel_scale = wheel_scales(seed, realism, wheels)
        self._slip = Wander(stream(seed, "wheel slip"), wheels, realism.wheel_slip, realism.slip_time_s, sense_s)
        self._scatter = Wander(
            stream(seed, "servo speed"),
            len(self._servos),
            realism.servo_speed_scatter,
            realism.scatter_time_s,
            sense_s,
        )
        self._stretch = _floats(self._wheel_scale * (1.0 + self._slip.values))
        """Distance that each wheel rolls per nominal metre now."""
        self._speed_factors = _floats(1.0 + self._scatter.values)
        """Speed of each servo as a share of the commanded one."""
        self._rolled_m = [0.0] * wheels
        self._contacts: deque[frozenset[ContactPair]] = deque(maxlen=CONTACT_MEMORY)
        self._pressed = Bumper()
        self._place_visuals()
        self.set_latch("unknown")
        self._settle()

    def __enter__(self) -> World:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._bullet.close()

    @property
    def time_ns(self) -> int:
        """Simulated time since the start, ns."""
        return self._steps * 1_000_000_000 // self._hz

    # --- commands and states ----------------------------------------------------------------------

    def command_base(self, command: BaseCommand) -> str:
        """Command wheel speeds. Returns '' when they are accepted, otherwise the reason for refusing."""
        return self._base.command(command, self.time_ns)

    def command_servos(self, group: Group, command: ServoCommand) -> str:
        """Command joints of 'arm' or 'hand', all or none. Returns '' when accepted, otherwise the reason for
        refusing."""
        return self._groups[group].command(command, self.time_ns)

    def set_latch(self, state: LatchState, service: str | None = None) -> None:
        """Set the latch of one of base, arm and hand, or of all. Thread-safe."""
        if service in (None, "base"):
            self._base.set_latch(state)
        for name, group in self._groups.items():
            if service in (None, name):
                group.set_latch(state)

    def base_state(self) -> BaseState:
        return self._base.state(self.time_ns)

    def servo_state(self, group: Group) -> ServoState:
        return self._groups[group].state(self.time_ns)

    # --- time -------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance the physics by one step, 1 / `physics_hz` seconds."""
        now_ns, dt_s = self.time_ns, self._dt_s
        if self._steps % self._sense_every == 0:
            self._read_contacts()
            self._stretch = _floats(self._wheel_scale * (1.0 + self._slip.step()))
            self._speed_factors = _floats(1.0 + self._scatter.step())
            for joint, servo in zip(self._mechanism.joints, self._servos, strict=True):
                servo.slip_rad = self._wear.slip_rad(joint, self._steps / self._hz)
        stretch, radii_m = self._stretch, self._radii_m
        wheels_mps = self._base.wheels(now_ns, dt_s)
        self._mechanism.spin(
            [mps * share / radius_m for mps, share, radius_m in zip(wheels_mps, stretch, radii_m, strict=True)], dt_s
        )
        for group in self._groups.values():
            group.expire(now_ns)
        self._drive_servos()

        self._stage.move(self._steps / self._hz, dt_s)
        self._bullet.stepSimulation()
        self._steps += 1

        now_ns = self.time_ns
        readings = self._mechanism.read()
        for servo, reading in zip(self._servos, readings, strict=False):
            servo.sense(*reading, now_ns)
        before, self._rolled_m = self._rolled_m, self._rolled(readings)
        # The encoders count turns of the wheel, not the distance that it made with them.
        counted_m = [(now - was) / share for now, was, share in zip(self._rolled_m, before, stretch, strict=True)]
        self._base.strained([torque_nm for _, _, torque_nm in readings[len(self._servos) :]])
        self._base.rolled(counted_m, now_ns, dt_s)

    # --- truth, and what the renderer draws ---------------------------------------------------------

    def truth(self) -> Truth:
        """The true poses and contacts."""
        pairs = frozenset().union(*self._contacts)
        touched: dict[str, set[str]] = {label: set() for label in self._stage.labels}
        for one, other in pairs:
            if one in touched:
                touched[one].add(other)
            if other in touched:
                touched[other].add(one)
        objects = []
        for number, label in enumerate(self._stage.labels):
            position, orientation = self._stage.pose(label)
            objects.append(
                TrueObject(
                    label=label,
                    kind="object" if number < self._stage.object_count else "obstacle",
                    position_m=position,
                    orientation=orientation,
                    touching=tuple(sorted(touched[label])),
                )
            )
        body, orientation = self._mechanism.root()
        return Truth(
            stamp_ns=self.time_ns,
            body_m=body,
            body_orientation=orientation,
            joints_rad=dict(zip(self._mechanism.joints, self._angles(), strict=True)),
            objects=tuple(objects),
            collisions=collisions(
                pairs,
                frozenset(self._model.links),
                frozenset({*self._model.body.wheels, *CASTERS}),
                self._jaws,
                frozenset(self._stage.labels[: self._stage.object_count]),
            ),
        )

    def body_pose(self) -> FloatArray:
        """World pose of the body frame, (4, 4)."""
        return self._mechanism.root_pose()

    def wheels(self) -> WheelMotion:
        """The present drive of the wheels, independent of what the base reports."""
        return WheelMotion(self._base.ramp.fastest_mps, self._base.stopped_by == "no command")

    @property
    def light(self) -> Light:
        return self.scene.light

    @property
    def visuals(self) -> Sequence[Visual]:
        """Everything to draw except the room."""
        return self._visuals

    def view(self) -> tuple[FloatArray, FloatArray]:
        """`visual_poses` and `camera_pose` now: the links' poses, of which both are made, are computed once."""
        links = self._mechanism.link_poses()
        return self._visual_poses(links), self._link_pose(links, self.robot.eye.link)

    def visual_poses(self) -> FloatArray:
        """World poses of `visuals` now, in their order, (n, 4, 4)."""
        return self._visual_poses(self._mechanism.link_poses())

    def camera_pose(self) -> FloatArray:
        """World pose of the camera, (4, 4); its frame is x right, y down, z forward."""
        return self.link_pose(self.robot.eye.link)

    def link_pose(self, link: str) -> FloatArray:
        """World pose of a link of the robot description, (4, 4)."""
        return self._link_pose(self._mechanism.link_poses(), link)

    # --- inside -------------------------------------------------------------------------------------

    def _visual_poses(self, links: FloatArray) -> FloatArray:
        poses = np.empty((len(self._visuals), 4, 4))
        on_robot = len(self._carriers)
        np.matmul(links[self._carriers], self._offsets, out=poses[:on_robot])
        poses[on_robot:] = self._stage.poses()
        return poses

    def _link_pose(self, links: FloatArray, link: str) -> FloatArray:
        carrier, offset = self._model.carried[link]
        pose: FloatArray = links[self._mechanism.index[carrier]] @ offset
        return pose

    def _place_visuals(self) -> None:
        rows = self._model.visuals()
        self._carriers = np.array([self._mechanism.index[carrier] for carrier, _, _ in rows])
        self._offsets = np.array([offset for _, offset, _ in rows])
        self._visuals = [visual for _, _, visual in rows] + self._stage.visuals

    def _settle(self) -> None:
        """Let everything come to rest on the floor before simulated time begins."""
        self._mechanism.spin([0.0] * len(self._radii_m), self._dt_s)
        self._drive_servos()
        for _ in range(round(SETTLE_S * self._hz)):
            self._bullet.stepSimulation()
        readings = self._mechanism.read()
        for servo, reading in zip(self._servos, readings, strict=False):
            servo.sense(*reading, 0)
        self._rolled_m = self._rolled(readings)
        self._read_contacts()

    def _rolled(self, readings: Sequence[JointReading]) -> list[float]:
        """Way that each wheel's rim has gone, m."""
        wheels = readings[len(self._servos) :]
        return [angle_rad * radius_m for (angle_rad, _, _), radius_m in zip(wheels, self._radii_m, strict=True)]

    def _angles(self) -> list[float]:
        return [servo.angle_rad for servo in self._servos]

    def _drive_servos(self) -> None:
        """Send new targets to the motors whose targets have changed."""
        driven, joints, factors = self._driven, self._mechanism.joints, self._speed_factors
        for number, servo in enumerate(self._servos):
            drive = servo.drive(factors[number])
            if drive != driven[number]:
                driven[number] = drive
                self._mechanism.drive(joints[number], drive)

    def _read_contacts(self) -> None:
        pairs, on_chassis = touching_pairs(
            self._bullet.getContactPoints(), self._mechanism.body, self._mechanism.link_names, self._names
        )
        self._contacts.append(pairs)
        before = self._pressed
        felt = on_chassis and self.robot.base.bumper
        pressed = bumper(on_chassis, self._mechanism.root_pose()) if felt else Bumper()
        self._base.bumper = Bumper(pressed.left or before.left, pressed.right or before.right)
        self._pressed = pressed


def _floats(values: FloatArray) -> list[float]:
    """Python's numbers, with which single operations are several times as fast."""
    numbers: list[float] = values.tolist()
    return numbers
