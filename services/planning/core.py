"""The planner's pure core: samples in, commands and status out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from cocoro import topics
from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.core import Output, Sample, Schedule, Take
from cocoro.messages import BaseCommand, Intent, LearnedModel, PlannerStatus, ServoCommand
from cocoro.messages.actions import Approach, Explore, Idle, Search
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import Topic
from services.planning.arm import ArmStep
from services.planning.behaviours import Actuators, Behaviour, Idling, Plan, Snapshot, behaviour_for
from services.planning.config import PlanningConfig
from services.planning.floor_plan import FloorPlanner
from services.planning.learned import Learned
from services.planning.of_body import of_body
from services.planning.state_estimator import StateEstimator
from services.planning.without_depth import of_sight

NO_COMMAND = "no command"
"""`BaseState.stopped_by` while the planner's commands do not arrive."""


class PlanningCore:
    """The planner as a `cocoro.core.Core`. Without a fresh state of the robot it stands still and reports why."""

    LONGEST_STEP_S: ClassVar[float] = 0.05
    """Motion advances by at most this much time in one step."""

    def __init__(self, robot: Robot, config: PlanningConfig) -> None:
        config = of_sight(of_body(config, robot), robot)
        self._config = config
        self._estimator = StateEstimator(
            config, robot, Catalogue.load(Path(config.objects) if config.objects else None)
        )
        self.actuators = Actuators(robot, config)
        self._intent = Intent(action=Idle())
        self._behaviour: Behaviour = Idling(Idle())
        self._ended: Plan | None = None
        self._last_ns: int | None = None
        self._servo_restarts = 0
        self._missing_since_ns: int | None = None
        self._looks_to: tuple[float, float] | None = None
        """Goal of the neck, where there is one."""
        self._floor_plan = FloorPlanner()

        self.learned = Learned(robot, config)
        if config.model:
            self.learned.load(config.model)
        self._use_learned()

    def _use_learned(self) -> None:
        learned = self.learned
        self.actuators.reacher.use(learned.hand)
        self.actuators.reachability.use(learned.map, learned.mesh)
        self.actuators.camera_tilt = self._estimator.camera_tilt = learned.camera_tilt
        self.actuators.driver.turn_with(learned.separation_m)
        base, learned_m = self.actuators.robot.base, learned.separation_m
        self._estimator.turning.ratio = base.axle_m / learned_m if learned_m is not None else 1.0

    reads: Mapping[Topic, Take] = {  # type: ignore[type-arg]
        topics.BASE_STATE: "all",
        topics.ARM_STATE: "all",
        topics.HAND_STATE: "all",
        topics.DETECTIONS: "all",
        topics.OBSTACLES: "all",
        topics.INTENT: "latest",
        topics.MODEL: "all",
        topics.POLICY_ACTIONS: "latest",
    }

    @property
    def schedule(self) -> Schedule:
        """A detection brings the next step forward, so that the wheels do not wait for up to a period."""
        return Schedule(self._config.rate_hz, (topics.DETECTIONS,))

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        around = self._estimator.around
        around.way = None  # a course that is under way sets it anew
        outputs = self._step(inputs, now_ns)
        if self._floor_plan.due(now_ns):
            return [*outputs, Output(topics.FLOOR_PLAN, self._floor_plan.made(around.floor, around.way))]
        return outputs

    def _step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        for sample in inputs:
            if isinstance(sample.message, LearnedModel):
                self.learned.take(bytes(sample.message.content))
                self._use_learned()
            self._estimator.take(sample.topic, sample.message, now_ns)
        if self._estimator.servo_restarts != self._servo_restarts:
            # The arm may stand anywhere since: a goal from before would be a motion that nobody checked.
            self._servo_restarts = self._estimator.servo_restarts
            self.actuators.arm.resync()
        self._estimator.localise(now_ns)
        self.learned.step(self._estimator.sightings_of(self._config.marker), now_ns)
        dt_s = self._elapsed(now_ns)
        self._follow_intent(now_ns)
        missing, hand, body = self._estimator.missing(now_ns), self._estimator.hand, self._estimator.body()
        if missing or hand is None or body is None:
            self.actuators.arm.late(dt_s)
            # An explicit zero: silence would let the base hold its last command until that expires.
            return [
                Output(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.0, turn_radps=0.0)),
                *self._halt(missing or "no odometry yet", now_ns),
            ]
        self.actuators.grip.feel(hand, now_ns)
        latched = self._estimator.latched()
        if latched:
            self.actuators.grip.keep()
            self.actuators.arm.resync()
            return self._halt(latched, now_ns)
        self._missing_since_ns = None
        if self._estimator.base is not None and self._estimator.base.stopped_by == NO_COMMAND:
            self.actuators.arm.undelivered()
        # On a way with the arm folded; a pose that changes under a hand at its target would move the hand.
        on_way = isinstance(self._intent.action, Approach) and self.actuators.arm.parked(self._estimator.angles())
        self._estimator.look_around(now_ns, self._own_hull, on_way=on_way)
        snapshot = Snapshot(now_ns, dt_s, self._estimator, body, self._estimator.angles(), self.actuators)
        plan = self._plan(snapshot)
        if isinstance(self._behaviour, Idling):
            self.learned.rest()
        status = self._status(plan, snapshot)
        return [*self._commands(plan, snapshot), *plan.reports, Output(topics.PLAN, status)]

    def _own_hull(self, angles: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
        """Hull of the robot and of what it holds: sphere centres, (n, 3), body frame, m, and radii, (n,), m."""
        centres, radii = self.actuators.arm.clearance.hull(angles)
        off = self.learned.offset_m(angles)
        if off is not None:  # the camera sees the arm with this offset, and with a smaller one near the shoulder
            centres, radii = np.vstack([centres, centres + off / 2, centres + off]), np.tile(radii, 3)
        held = self.actuators.reacher.position(angles)
        chassis = np.array([0.0, 0.0, 0.0])
        own_m = self.actuators.robot.base.chassis_diameter_m / 2 + 0.03
        return np.vstack([centres, held, chassis]), np.append(radii + 0.03, [0.09, own_m])

    def _elapsed(self, now_ns: int) -> float:
        last_ns, self._last_ns = self._last_ns, now_ns
        if last_ns is None or now_ns <= last_ns:
            return 1.0 / self._config.rate_hz
        # After a pause, motion continues without a jump.
        return min((now_ns - last_ns) / NS, self.LONGEST_STEP_S)

    def _follow_intent(self, now_ns: int) -> None:
        fresh = self._estimator.fresh_intent(now_ns)
        current = self._intent
        intent = fresh or Intent(task_id=current.task_id, step=current.step, action=Idle())
        if (intent.task_id, intent.step, intent.action) == (current.task_id, current.step, current.action):
            return
        searching = isinstance(current.action, (Search, Explore)) and isinstance(intent.action, (Search, Explore))
        if not searching or intent.task_id != current.task_id:
            self._estimator.seen.end(intent.task_id)
        self._intent = intent
        self._ended = None
        if fresh is None:
            self._behaviour = Idling(Idle(), f"nothing from the executive for over {topics.INTENT.max_age_s:g} s")
        else:
            self._behaviour = behaviour_for(intent.action)

    def _plan(self, snapshot: Snapshot) -> Plan:
        """Step the behaviour. After its end, hold still and repeat its result."""
        if self._ended is not None:
            return Plan(
                snapshot.stand(),
                snapshot.still(),
                self._ended.why,
                None,
                self._ended.state,
                self._ended.reason,
                self._ended.distance_m,
            )
        plan = self._blind(snapshot) or self._behaviour.step(snapshot)
        self.slow_down(plan, snapshot)
        if plan.state != "running" and not isinstance(self._behaviour, Idling):
            self._ended = plan
        return plan

    def slow_down(self, plan: Plan, snapshot: Snapshot) -> None:
        """Limit the speed so that the robot can still stop in time if the service with the oldest message has died. A
        late service slows the robot down, and then stops it."""
        driver, base = self.actuators.driver, self.actuators.robot.base
        who, age_s = self._estimator.oldest(snapshot.now_ns, sight=self._behaviour.needs_sight)
        unheard_s = self._estimator.intent_age_s(snapshot.now_ns)
        if unheard_s > base.command_timeout_s:
            plan.base = driver.pause(snapshot.dt_s)
            plan.why = f"standing still: nothing from the executive for {unheard_s:.1f} s"
            return
        # The command holds until the next step.
        limit_mps = base.speed_at_age_mps(age_s + 1.0 / self._config.rate_hz)
        slower = driver.within(plan.base, limit_mps)
        if slower is not plan.base:
            plan.base, plan.why = slower, f"slower, for {who} is late; {plan.why}"

    def _blind(self, snapshot: Snapshot) -> Plan | None:
        """Pause a behaviour that needs sight while perception is late, and fail it after `blind_for_good_s`. None
        while there is no reason to pause."""
        if not self._behaviour.needs_sight:
            return None
        blind_s = self._estimator.blind_s(snapshot.now_ns)
        if blind_s is None:
            return None
        why = f"standing still: nothing from perception for {self._estimator.unseen_s(snapshot.now_ns):.1f} s"
        plan = Plan(snapshot.actuators.driver.pause(snapshot.dt_s), snapshot.still(), why)
        if blind_s > self._config.blind_for_good_s:
            plan.state, plan.reason = "failed", "stale"
        return plan

    def _halt(self, why: str, now_ns: int) -> Sequence[Output]:
        """Command nothing, so that the hardware stops by itself. The claws' goals stay: the last ones may have been
        lost on their way."""
        self.actuators.driver.reset()
        self._looks_to = None
        if self._missing_since_ns is None or now_ns < self._missing_since_ns:
            self._missing_since_ns = now_ns
        failed = (
            not isinstance(self._intent.action, Idle)
            and now_ns - self._missing_since_ns > self._config.stale_for_good_s * NS
        )
        body = self._estimator.body()
        status = PlannerStatus(
            task_id=self._intent.task_id,
            step=self._intent.step,
            behaviour=self._intent.action.name,
            state="failed" if failed else "running",
            reason="stale" if failed else "",
            why=f"standing still: {why}",
            holding=self.actuators.grip.holding(now_ns),
            body_m=(body.x_m, body.y_m) if body is not None else None,
            body_yaw_rad=body.yaw_rad if body is not None else 0.0,
        )
        return [Output(topics.PLAN, status)]

    def _status(self, plan: Plan, snapshot: Snapshot) -> PlannerStatus:
        x, y, z = self.actuators.reacher.position(snapshot.angles)
        label = self._intent.action.target
        return PlannerStatus(
            task_id=self._intent.task_id,
            step=self._intent.step,
            behaviour=self._intent.action.name,
            state=plan.state,
            reason=plan.reason,
            why=plan.why,
            target=snapshot.target(label) if label else None,
            distance_m=plan.distance_m,
            hand_m=(float(x), float(y), float(z)),
            holding=snapshot.holding,
            body_m=(snapshot.body.x_m, snapshot.body.y_m),
            body_yaw_rad=snapshot.body.yaw_rad,
            known=self._estimator.memory.all(snapshot.body, snapshot.now_ns),
            model=self.learned.text,
        )

    def _commands(self, plan: Plan, snapshot: Snapshot) -> list[Output]:
        base: BaseCommand = plan.base
        step: ArmStep = plan.arm
        if plan.head is not None:
            self._looks_to = plan.head[:2]
        if self._looks_to is None:
            self._looks_to = snapshot.looks_rad
        head_speed = plan.head[2] if plan.head is not None else 1.0
        neck = self.actuators.gaze.joints
        looks_to = self._looks_to if neck else ()
        arm = ServoCommand(
            joints=(*neck, *self.actuators.robot.arm.joints),
            goal_rad=(*looks_to, *(float(angle) for angle in step.goal_rad)),
            speed_radps=(*(head_speed for _ in neck), *(float(speed) for speed in step.speed_radps)),
        )
        hand = self.actuators.grip.command(step.roll_rad)
        return [
            Output(topics.BASE_COMMAND, base),
            Output(topics.ARM_COMMAND, arm),
            Output(topics.HAND_COMMAND, hand),
        ]
