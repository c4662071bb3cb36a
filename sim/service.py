"""The simulator's service: replaces kinect, base, arm and hand on their topics, and drives the clock."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack, ExitStack
from heapq import heappop, heappush
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Protocol, Self

import msgspec
from msgspec import Meta

from cocoro import topics
from cocoro.arrays import FloatArray
from cocoro.clock import NS, Clock
from cocoro.component import Implementation
from cocoro.joints import Group
from cocoro.latch import ServiceLatch
from cocoro.messages import BaseCommand, BaseState, ClockTick, Frame, LatchState, Message, ServoCommand
from cocoro.node import Node
from cocoro.publisher import Publisher
from cocoro.robot import Robot
from sim.camera import SimKinect
from sim.component import SIM
from sim.kinds import BodyKind, Sensors
from sim.motion import MotionWriter
from sim.random_scene import find_scene
from sim.realism import BodyRealism, body_of
from sim.render import Lighting, make_renderer
from sim.render.choice import RendererChoice
from sim.scene_names import DEFAULT
from sim.world import Motors, World, message_motors

TICK_HZ = 120
"""Rate of the clock topic. The physics runs a whole number of steps between ticks."""
FRAME_LATENCY_S = 0.033
"""Time from the middle of a frame's exposure to its delivery: half an exposure, read-out and transfer, as the driver of
the hardware assumes (`least_age_s` of services/kinect/device.py)."""
STATE_LATENCY_S = 0.005
"""Time from a state's stamp to its publication, with real sensors."""
FRAME_LATENCY_NS = round(FRAME_LATENCY_S * NS)
LATE_S = 0.05
"""When it is further behind real time than this, simulated time slips instead of catching up: a clock that hurries
makes the others' messages late."""


class SimConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    scene: str = DEFAULT
    target: str = ""
    """An object that a random scene must contain."""
    objects: str = ""
    """The file of known objects that the robot was given: a scene's objects have their colours; '' is the project's
    own."""
    seed: Annotated[int, Meta(ge=0)] = 0
    sensors: Sensors = "ideal"
    width: Annotated[int, Meta(ge=16, le=4096)] = 640
    height: Annotated[int, Meta(ge=16, le=4096)] = 480
    frame_rate_hz: Annotated[float, Meta(gt=0, le=120)] = 30.0
    state_rate_hz: Annotated[float, Meta(gt=0, le=120)] = 50.0
    physics_hz: Annotated[int, Meta(ge=TICK_HZ, multiple_of=TICK_HZ)] = 240
    pace: Annotated[float, Meta(ge=0.01, le=1)] = 1.0
    """Simulated seconds per real second: less gives a busy machine, or people who watch, more time."""
    battery_fraction: Annotated[float, Meta(ge=0, le=1)] = 1.0
    """Charge that the base reports; it does not change."""
    command_timeout_s: Annotated[float, Meta(gt=0)] | None = None
    """Replaces the robot's deadman time; only the lock-step baseline does."""
    renderer: RendererChoice = "auto"
    body: BodyKind = "nominal"
    """worn: the body differs from the nominal description by errors drawn from the seed, unknown to all services."""
    bend_at_s: Annotated[float, Meta(ge=0)] | None = None
    """Time at which the forearm is bent, by 3 cm at the hand."""
    motion: str = ""
    """A file for the body's motion at each physics step (`sim.motion`); '' for none."""
    camera_process: bool = False
    """Draw the camera's pictures in a process of its own, while everything else goes on. The pictures are the same."""


class SimCamera(Protocol):
    """A camera that exposes a frame now and delivers it later. A context manager."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def expose(self, poses: FloatArray, camera_pose: FloatArray, stamp_ns: int, light: Lighting) -> Callable[[], Frame]:
        """See `SimKinect.expose`."""


class _Outbox:
    """Holds messages back until their latency, by simulated time, is over."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, int, Publisher[Any], Message | Callable[[], Message]]] = []
        self._count = 0

    def put(self, publisher: Publisher[Any], message: Message | Callable[[], Message], due_ns: int) -> None:
        """Keep a message, or a function that gives it, until its time."""
        heappush(self._waiting, (due_ns, self._count, publisher, message))
        self._count += 1

    def flush(self, now_ns: int) -> None:
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, publisher, waiting = heappop(self._waiting)
            message = waiting if isinstance(waiting, Message) else waiting()
            publisher.put(message, message.stamp_ns)


class _Every:
    """Tells in which physics steps something with a fixed rate is due."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._done = -1

    def due(self, now_ns: int) -> bool:
        count = int(now_ns * self._rate_hz / NS + 1e-6)
        if count <= self._done:
            return False
        self._done = count
        return True


class Simulator:
    """Steps the world and exchanges its commands, states and frames with the mesh."""

    def __init__(self, node: Node, config: SimConfig, world: World, camera: SimCamera) -> None:
        self._config = config
        self._world = world
        self._camera = camera
        self._clock = node.clock
        self._outbox = _Outbox()
        self._state_due = _Every(config.state_rate_hz)
        self._frame_due = _Every(config.frame_rate_hz)
        self._truth_due = _Every(topics.TRUTH.rate_hz or 30.0)
        real = config.sensors == "real"
        self._state_latency_ns = round(STATE_LATENCY_S * NS) if real else 0
        self._ticks = node.publisher(topics.CLOCK)
        self._truth = node.publisher(topics.TRUTH)
        self._states: tuple[tuple[Publisher[Any], Callable[[], Message]], ...] = ()
        self.rate = 1.0
        self._motion: MotionWriter | None = None
        self.makes_time = node.clock.needs_ticks
        """Whether the robot's clock follows this simulator; otherwise the simulator keeps up with the clock."""
        node.drive_clock()

    def connect_camera(self, kinect: Node) -> None:
        """Replace the camera only."""
        self._frames = kinect.publisher(topics.FRAME)

    def connect(self, kinect: Node, base: Node, arm: Node, hand: Node) -> None:
        """Replace all of the robot's hardware."""
        world = self._world
        self.connect_camera(kinect)
        self._states = (
            (base.publisher(topics.BASE_STATE), self._base_state),
            (arm.publisher(topics.ARM_STATE), lambda: world.servo_state("arm")),
            (hand.publisher(topics.HAND_STATE), lambda: world.servo_state("hand")),
        )
        for node in (base, arm, hand):
            self._keep_latch(node)
        base.on(topics.BASE_COMMAND, self._command_base)
        arm.on(topics.ARM_COMMAND, lambda command: self._command_servos("arm", command))
        hand.on(topics.HAND_COMMAND, lambda command: self._command_servos("hand", command))

    def _keep_latch(self, node: Node) -> None:
        def changed(state: LatchState, by: str) -> None:
            self._world.set_latch(state, node.name)

        def halt() -> None:
            self._world.set_latch("latched", node.name)

        ServiceLatch(node, changed, halt)

    def _base_state(self) -> BaseState:
        state = self._world.base_state()
        state.battery_fraction = self._config.battery_fraction
        return state

    def _command_base(self, command: BaseCommand) -> None:
        self._world.command_base(command)

    def _command_servos(self, group: Group, command: ServoCommand) -> None:
        self._world.command_servos(group, command)

    def tick(self) -> None:
        """Advance the clock by one tick: run the physics steps in it, and publish what becomes due."""
        world = self._world
        for _ in range(self._config.physics_hz // TICK_HZ):
            world.step()
            if self._motion is not None:
                self._motion.step()
            now_ns = world.time_ns
            if self._state_due.due(now_ns):
                for publisher, state in self._states:
                    self._outbox.put(publisher, state(), now_ns + self._state_latency_ns)
            if self._truth_due.due(now_ns):
                self._outbox.put(self._truth, world.truth(), now_ns)
            if self._frame_due.due(now_ns):
                frame = self._camera.expose(*world.view(), now_ns, world.light)
                self._outbox.put(self._frames, frame, now_ns + FRAME_LATENCY_NS)
        self.publish_time()
        self._outbox.flush(world.time_ns)
        if self._motion is not None:
            self._motion.flush()

    def write_motion(self, path: Path) -> MotionWriter:
        """Record the body's motion from now on, until the returned context manager is left. Raises ConfigError."""
        self._motion = MotionWriter(path, self._world)
        return self._motion

    def publish_time(self) -> None:
        sent = self._ticks.put(ClockTick(rate=self.rate), self._world.time_ns)
        self._clock.tick(sent.stamp_ns, sent.incarnation, self.rate)


async def run(node: Node, config: SimConfig) -> None:
    """Simulate for ever, in real time or in the event loop's virtual time."""
    with make_world(node.robot, config) as world, make_camera(node.robot, config, world) as camera:
        simulator = Simulator(node, config, world, camera)
        async with AsyncExitStack() as stack:
            hardware = [await stack.enter_async_context(node.sibling(name)) for name in SIM.services]
            simulator.connect(*hardware)
            simulator.publish_time()  # before any service is ready, so that none starts work in an epoch that ends
            for part in (node, *hardware):
                part.ready(f"simulated, scene {world.scene.name}, {config.sensors} sensors")
            await keep_going(node, config, simulator)


implementation = Implementation(SimConfig, run)


def make_world(
    robot: Robot,
    config: SimConfig,
    motors: Callable[[Robot, Mapping[str, float], BodyRealism], Motors] = message_motors,
) -> World:
    """Make the world: the scene with the robot in it."""
    return World(
        _with_timeout(robot, config.command_timeout_s),
        find_scene(config.scene, config.seed, config.target, config.objects, robot),
        seed=config.seed,
        sensors=config.sensors,
        physics_hz=config.physics_hz,
        wear=body_of(robot, config.body, config.seed, config.bend_at_s),
        motors=motors,
    )


def make_camera(robot: Robot, config: SimConfig, world: World) -> SimCamera:
    """The camera that the configuration asks for, in this process or in its own."""
    if not config.camera_process:
        return make_kinect(robot, config, world)
    from sim.camera_process.remote import RemoteKinect

    return RemoteKinect(
        robot, world.visuals, sensors=config.sensors, seed=config.seed, width=config.width, height=config.height,
        renderer=config.renderer, slots=ceil(FRAME_LATENCY_S * config.frame_rate_hz) + 2,
    )  # fmt: skip


def make_kinect(robot: Robot, config: SimConfig, world: World) -> SimKinect:
    camera = robot.camera.scaled(config.width, config.height)
    renderer = make_renderer(world.visuals, camera, config.renderer)
    return SimKinect(
        robot, renderer, sensors=config.sensors, seed=config.seed, width=config.width, height=config.height
    )


async def keep_going(node: Node, config: SimConfig, simulator: Simulator) -> None:
    """Tick for ever."""
    with ExitStack() as stack:
        if config.motion:
            stack.enter_context(simulator.write_motion(Path(config.motion)))
        if simulator.makes_time:
            await _in_real_time(simulator, config.pace)
        else:
            await _at_the_clocks_pace(simulator, node.clock)


async def _at_the_clocks_pace(simulator: Simulator, clock: Clock) -> None:
    ticks = 0
    while True:
        ticks += 1
        await clock.sleep_until(ticks * NS // TICK_HZ)
        simulator.tick()


async def _in_real_time(simulator: Simulator, pace: float) -> None:
    """Tick by the monotonic clock. When that is too fast for the machine, simulated time slips and the rate says so."""
    due_s = measured_s = time.monotonic()
    simulator.rate = pace
    tick_s = 1 / TICK_HZ / pace
    ticks = 0
    while True:
        due_s += tick_s
        behind_s = time.monotonic() - due_s
        if behind_s > LATE_S:
            due_s += behind_s
        await asyncio.sleep(max(-behind_s, 0.0))
        simulator.tick()
        ticks += 1
        if ticks == TICK_HZ:
            now_s = time.monotonic()
            simulator.rate = min(ticks / TICK_HZ / (now_s - measured_s), pace)
            measured_s, ticks = now_s, 0


def _with_timeout(robot: Robot, timeout_s: float | None) -> Robot:
    """The robot with another deadman time, equal at all speeds."""
    if timeout_s is None:
        return robot
    slow = robot.with_base(command_timeout_s=timeout_s, stand_within_s=timeout_s + 1.0)
    return slow.with_networks(command_timeout_s=timeout_s)
