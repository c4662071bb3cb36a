"""`cocoro rehearse`: the whole robot in one process, in virtual time, judged by the simulator's truth.

The services are the real ones, found by the process table and run on the local bus; only time and the bus differ
from a live run.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from apps.rehearsal.command_periods import command_periods
from apps.rehearsal.lockstep import LOCKSTEP_PLANNER, LOCKSTEP_SETTINGS, LockstepCycle, LockstepNode
from apps.rehearsal.progress import RehearsalProgress, Tell, ignored
from apps.rehearsal.request import RehearsalRequest
from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, VirtualClock
from cocoro.component import load
from cocoro.errors import CocoroError, ConfigError, choice_of
from cocoro.inbox import Stream
from cocoro.messages import BaseCommand, Detections, Frame, Recording, TaskReply, TaskRequest, TaskState, Truth
from cocoro.node import Node
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.task_errors import refusal
from cocoro.tasks import Task
from cocoro.vloop import run_virtual
from deploy.delayed import DelayedNode
from deploy.processes import named, needs
from services.executive.tasks.follow import CATCH_UP_S, WITHIN_M
from services.planning.config import FollowConfig
from sim.coverage import CoverageJudge
from sim.judge import Judge, PursuitJudge
from sim.random_scene import find_scene
from sim.realism import REALISM, body_of, wheel_scales
from sim.trace import Trace

if TYPE_CHECKING:
    from apps.learning.collector import SampleCollector

RECORDER = "capture"
PROCESSES = ("sim", "perception", "planning", "executive")
START_S = 5.0
"""Longest time until the robot accepts a task, simulated seconds."""


def rehearse(request: RehearsalRequest, tell: Tell = ignored) -> dict[str, Any]:
    """Run the tasks and return the result of the last one, as `--json` prints it, with that of each in `tasks`.

    `tell` gets the progress at each state of a task. Raises TaskRefusedError when the robot refuses one, ConfigError
    for a wrong scene or service name.
    """
    started = time.perf_counter()
    unknown = sorted(set(request.latency) - set(PROCESSES))
    if unknown:
        raise ConfigError(f"--latency {unknown[0]}: no such service; {choice_of(unknown[0], PROCESSES)}")
    if request.record is not None and Path(request.record).exists():
        raise ConfigError(f"--record {request.record}: there is such a file already")
    result = run_virtual(_Rehearsal(request, tell).run())
    result["wall_s"] = round(time.perf_counter() - started, 3)
    return result


class _Rehearsal:
    def __init__(self, request: RehearsalRequest, tell: Tell) -> None:
        self._request = request
        self._tell = tell
        self._robot = Robot.load(*(Path(file) if file else None for file in (request.description, request.measured)))
        self._task: Task = request.task
        """The task that runs now."""
        self._scene = find_scene(
            request.scene, request.seed, self._wanted(self._task), request.objects or "", self._robot
        )
        self._judge = self._judge_of(self._task)
        self._body = body_of(self._robot, request.body, request.seed).robot
        self._trace = Trace(self._body, self._present(self._task))
        self._coverage = (
            CoverageJudge(self._robot, self._scene, request.seen_within_m) if request.seen_within_m else None
        )
        self._asked = False
        self._steps: list[dict[str, Any]] = []
        """Results of the tasks that have ended, in order."""
        self._commands_ns: list[int] = []
        """Stamps of the wheel commands since the first task was accepted."""
        self._commanded = False
        self._frame: Frame | None = None
        self._seen: Detections | None = None
        self._recording: Recording | None = None
        self._collector: SampleCollector[Any] | None = None

    async def run(self) -> dict[str, Any]:
        request = self._request
        mesh, clock, robot = LocalMesh(), VirtualClock(), self._robot
        cycle = LockstepCycle()
        async with AsyncExitStack() as stack:
            services = []
            more = dict.fromkeys(service for task in (request.task, *request.then) for service in task.services)
            for name in (*((RECORDER,) if request.record else ()), *PROCESSES, *more):
                lockstep = request.lockstep and name in LockstepCycle.ORDER
                row = LOCKSTEP_PLANNER if lockstep and name == "planning" else named(name)
                component = load(row)
                settings = self._settings(name)
                if request.objects is not None and "objects" in component.config.__struct_fields__:
                    settings["objects"] = request.objects
                if "needed" in component.config.__struct_fields__:
                    settings["needed"] = needs(name)
                config = msgspec.convert(settings, component.config)
                make_node = partial(LockstepNode, cycle=cycle) if lockstep else DelayedNode
                node = make_node(
                    name, mesh.join(), clock, robot, latency_s=request.latency.get(name, 0.0),
                    record_steps=request.record is not None, module=row.module, config=config,
                )  # fmt: skip
                await stack.enter_async_context(node)
                services.append(asyncio.ensure_future(component.run(node, config)))
            operator = await stack.enter_async_context(Node("operator", mesh.join(), clock, robot))
            operator.on(topics.TRUTH, self._feed_judge)
            operator.on(topics.TRUTH, self._trace.feed)
            operator.on(topics.PLAN, self._trace.status)
            operator.on(topics.TASK, self._trace.state)
            operator.on(topics.BASE_COMMAND, self._keep_command)
            operator.on(topics.RECORDING.of(RECORDER), self._keep_recording)
            samples = request.task.samples
            if request.samples is not None and samples is not None:
                from apps.learning.collector import collector

                self._collector = collector(samples, Path(request.samples), robot, self._standing_height_m())
                stack.enter_context(self._collector)
            task = asyncio.ensure_future(self._operate(operator))
            try:
                await asyncio.wait((task, *services), return_when=asyncio.FIRST_COMPLETED)
                for service in services:
                    if service.done():
                        service.result()
                        raise CocoroError("a service of the rehearsal ended by itself")
                state = task.result()
            finally:
                for future in (task, *services):
                    future.cancel()
                await asyncio.gather(task, *services, return_exceptions=True)
        if self._recording is not None and self._recording.fault:
            raise CocoroError(self._recording.fault)
        return self._result(state)

    @staticmethod
    def _wanted(task: Task) -> str:
        """The object that the scene must have; '' for a task that names none."""
        return task.target if task.needs_label else ""

    def _present(self, task: Task) -> str:
        """The task's target, or '' where the scene has no such object."""
        return task.target if task.target in [item.label for item in self._scene.objects] else ""

    def _judge_of(self, task: Task) -> Judge | PursuitJudge:
        present = self._present(task)
        if task.pursuit_phase and present:
            return PursuitJudge(
                self._robot, self._scene, present,
                distance_m=FollowConfig().distance_m, within_m=WITHIN_M, catch_up_s=CATCH_UP_S,
            )  # fmt: skip
        return Judge(self._robot, self._scene, present)

    def _feed_judge(self, truth: Truth) -> None:
        self._judge.feed(truth)
        if self._coverage is not None and self._asked:
            self._coverage.feed(truth)

    def _settings(self, name: str) -> dict[str, Any]:
        request = self._request
        if name == RECORDER:
            return {"file": request.record}
        held = LOCKSTEP_SETTINGS.get(name, {}) if request.lockstep else {}
        if name == "sim":
            world: dict[str, Any] = {
                field: getattr(request, field)
                for field in ("scene", "seed", "sensors", "body", "width", "height", "frame_rate_hz", "camera_process")
            }
            world |= {"target": self._wanted(request.task), "bend_at_s": request.bend_s}
            return world | held
        if name == "policy":
            return {"anything": True}  # who rehearses may run any program here
        if name == "planning":
            return {
                "model": request.model or "", "reach": request.reach, "see_hand": request.see_hand,
                "adapt": request.adapt,
            }  # fmt: skip
        return dict(held)

    async def _operate(self, operator: Node) -> TaskState:
        """Let the world run, then request each task and follow it to its end."""
        request = self._request
        states = operator.stream(topics.TASK)
        if request.picture is not None:
            operator.on(topics.FRAME, self._keep_frame)
            operator.on(topics.DETECTIONS, self._keep_seen)
        if self._collector is not None and request.task.samples is not None:
            operator.on(request.task.samples, self._collector.take)
        if request.wait_s:
            await operator.sleep(request.wait_s)
        for task in (request.task, *request.then):
            self._task, self._judge = task, self._judge_of(task)
            if self._collector is not None and task is request.task:
                left = task.count - len(self._collector)
                task = replace(task, first=self._collector.next, count=max(left, 1))
            question = TaskRequest(task=task, timeout_s=request.timeout_s)
            self._trace.begin(self._present(task))
            asked_ns, self._asked = operator.now_ns(), True
            reply = await self._ask(operator, question)
            while reply.refusal in ("not_alive", "estop") and operator.now_ns() - asked_ns < START_S * NS:
                await operator.sleep(0.1)
                reply = await self._ask(operator, question)
            if not reply.accepted:
                raise refusal(reply)
            self._commanded = True
            state = await self._watch(states, reply.task_id)
            self._keep_step(state)
            if state.outcome != "done":
                break
        return state

    async def _watch(self, states: Stream[TaskState], task_id: str) -> TaskState:
        phase = ""
        async for state in states:
            if state.task_id != task_id:
                continue
            if isinstance(self._judge, PursuitJudge) and state.phase == self._task.pursuit_phase:
                self._judge.begin()
            if phase and phase == self._task.snapshot_phase != state.phase:
                self._take_picture()
            phase = state.phase
            self._tell(self._progress(state))
            if state.outcome is not None:
                return state
        raise AssertionError("a stream has no end")

    def _progress(self, state: TaskState) -> RehearsalProgress:
        """The task's progress, by the samples that it is to report or by the time that it is to last."""
        share, said, for_s = None, "", getattr(self._task, "for_s", None)
        if self._collector is not None and self._task is self._request.task:
            share, said = len(self._collector) / self._task.count, self._collector.summary
        elif for_s and state.phase == self._task.pursuit_phase:
            share = min(state.elapsed_s / for_s, 1.0)
        return RehearsalProgress(state.phase, state.elapsed_s, share, said)

    def _keep_step(self, state: TaskState) -> None:
        """Keep the result of one task, by the truth at its end."""
        labels = {item.label: item for item in self._scene.objects}
        known = labels.get(state.label)
        edge_m = self._trace.edge_m(known.half_width_m) if known is not None else None
        self._steps.append(
            {
                "task": state.task,
                "label": state.label,
                "outcome": state.outcome,
                "reason": state.reason,
                "sim_s": round(state.elapsed_s, 3),
                "measures": state.measures,
                "hand_to_target": self._trace.hand_gap(),
                "target_edge_m": edge_m,
                "longest_stall_s": round(self._trace.longest_stall_s(), 3),
                "truth": msgspec.to_builtins(self._judge.result()),
            }
        )

    @staticmethod
    async def _ask(operator: Node, question: TaskRequest) -> TaskReply:
        try:
            return await operator.call(topics.RUN, question)
        except CocoroError as error:
            return TaskReply(accepted=False, refusal="not_alive", text=str(error))

    def _standing_height_m(self) -> float | None:
        """Height of the target's centre above the floor, m, by the catalogue; None for an unknown object."""
        catalogue = Catalogue.load(Path(self._request.objects) if self._request.objects else None)
        known = catalogue.get(self._task.target)
        return known.size_m[2] / 2 if known is not None else None

    def _keep_command(self, command: BaseCommand) -> None:
        if self._commanded:
            self._commands_ns.append(command.stamp_ns)

    def _keep_recording(self, recording: Recording) -> None:
        self._recording = recording

    def _keep_frame(self, frame: Frame) -> None:
        self._frame = frame

    def _keep_seen(self, seen: Detections) -> None:
        self._seen = seen

    def _take_picture(self) -> None:
        if self._frame is not None and self._request.picture is not None:
            from apps.pictures import draw, save_png

            catalogue = Catalogue.load(Path(self._request.objects) if self._request.objects else None)
            save_png(draw(self._frame, self._seen, catalogue), Path(self._request.picture))

    def _true_body(self) -> dict[str, Any]:
        request, separation_m = self._request, self._body.base.wheel_separation_m
        scales = wheel_scales(request.seed, REALISM[request.sensors], len(self._body.drive.names))
        return {
            "kind": request.body,
            "wheel_separation_m": separation_m,
            # Wheels that roll further than commanded turn the robot as if they were closer together.
            "turning_separation_m": separation_m and separation_m / float(scales.mean()),
        }

    def _result(self, state: TaskState) -> dict[str, Any]:
        request = self._request
        return {
            "task": self._task.name,
            "label": self._task.target,
            "scene": request.scene,
            "seed": request.seed,
            "sensors": request.sensors,
            "lockstep": request.lockstep,
            "model": self._trace.model,
            **({} if self._collector is None else {"samples": len(self._collector), "said": self._collector.summary}),
            "outcome": state.outcome,
            "reason": state.reason,
            "sim_s": round(state.elapsed_s, 3),
            "wall_s": 0.0,
            "measures": state.measures,
            "phases": [
                {"name": phase.name, "sim_s": round(((phase.end_ns or state.stamp_ns) - phase.start_ns) / NS, 3)}
                for phase in state.phases
            ],
            "truth": msgspec.to_builtins(self._judge.result()),
            "commands": msgspec.to_builtins(command_periods(self._commands_ns)),
            "tasks": self._steps,
            "body": self._true_body(),
            **({} if self._coverage is None else {"seen_floor": msgspec.to_builtins(self._coverage.result())}),
            **({"trace": self._trace.data()} if request.trace else {}),
        }
