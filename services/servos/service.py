"""The services of the servo groups: for each line, a thread talks to it, and for each group a pure core decides."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from contextlib import AsyncExitStack
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro import topics
from cocoro.component import Implementation
from cocoro.errors import CocoroError, ConfigError, choice_of
from cocoro.faults import FaultReporter
from cocoro.joints import GROUPS, KEEPS_GOAL, Group
from cocoro.latch import ServiceLatch
from cocoro.messages import LatchState, ServoCommand, ServoReply, ServoRequest, ServoState
from cocoro.node import Node
from cocoro.ports import port_path
from cocoro.robot import Robot
from cocoro.topics import Topic
from cocoro.units import PositiveShare
from services.servos.families import FAMILIES
from services.servos.group import ServoGroup
from services.servos.line import CycleResult, ServoLine
from services.servos.orders import GroupOrders

TOPICS: dict[Group, tuple[Topic[ServoState], Topic[ServoCommand]]] = {
    "arm": (topics.ARM_STATE, topics.ARM_COMMAND),
    "hand": (topics.HAND_STATE, topics.HAND_COMMAND),
}
DONE_S = 2.0


class ServosConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ports: dict[str, str] = {}
    """By the name of a line, `[network.NAME]` in the robot description, its serial port: a device, or wire:NAME for an
    emulated one."""
    port: str = "/dev/cocoro-{line}"
    """The port of a line that `ports` does not have; `{line}` stands for its name."""
    arm_port: str = ""
    """A former setting: the port of the line `arm`, if `ports` does not have it."""
    hand_port: str = ""
    reply_s: Annotated[float, Meta(gt=0, le=0.5)] = 0.03
    """Time limit for a servo's answer."""
    torque: dict[str, PositiveShare] = {}
    """By joint, the share of its stall torque that it may push with; by default all of it."""

    def port_of(self, line: str) -> str:
        """The port of a line, as the settings name it."""
        return self._named.get(line) or self.port.replace("{line}", line)

    @property
    def _named(self) -> dict[str, str]:
        """The ports that are set for one line."""
        former = {"arm": self.arm_port, "hand": self.hand_port}
        return {line: port for line, port in former.items() if port} | self.ports

    def check(self, robot: Robot) -> None:
        """Raises ConfigError for a line or a joint that the robot does not have."""
        named = ("ports", "line", self._named, robot.networks), ("torque", "joint", self.torque, robot.joints)
        for setting, kind, names, known in named:
            if unknown := sorted(set(names) - set(known)):
                choice = choice_of(unknown[0], known)
                raise ConfigError(f"[service.servos] {setting}: the robot has no {kind} {unknown[0]!r}; {choice}")


class GroupService:
    """One group: a participant of the mesh, whose core decides what the servos of its joints do."""

    def __init__(self, node: Node, group: Group) -> None:
        self._node = node
        self._reporter = FaultReporter(node)
        robot, keeps_goal = node.robot, group in KEEPS_GOAL
        joints = [robot.joints[name] for name in robot.group_joints(group)]
        row = robot.networks[robot.line_of(group)]
        self._state, command = TOPICS[group]
        self.core = ServoGroup(
            joints,
            FAMILIES[row.protocol],
            keeps_goal=keeps_goal,
            timeout_s=row.command_timeout_s,
            max_age_s=command.max_age_s,
        )
        self.orders = GroupOrders(keeps_goal=keeps_goal)
        self._epoch = node.clock.epoch
        self._changed = asyncio.Event()
        ServiceLatch(node, self._latched, self.orders.halt)
        node.on(command, self._commanded)
        node.serve(topics.SERVOS.of(node.name), self._asked)

    def _commanded(self, command: ServoCommand) -> None:
        now_ns = self._node.now_ns()
        self.core.command(command, now_ns)
        self.orders.give(self.core.orders(now_ns))

    def _latched(self, state: LatchState, by: str) -> None:
        self.core.set_latch(state)
        self.orders.give(self.core.orders(self._node.now_ns()))
        self.orders.go_on()  # these orders know of the latch

    def take(self, result: CycleResult) -> None:
        """Take the results of a cycle with this group's servos. The line's thread goes by the monotonic clock, the core
        by the robot's."""
        core, now_ns = self.core, self._node.now_ns()
        if self._node.clock.epoch != self._epoch:
            self._epoch = self._node.clock.epoch
            core.new_epoch()
        monotonic_ns = time.monotonic_ns()
        core.port_fault = result.port_fault
        if result.port_fault:
            core.port_lost(result.port_fault)
        for number, reading in result.readings.items():
            core.read(number, reading, now_ns - max(monotonic_ns - reading.at_ns, 0))
        missed = [number for number in result.missed if not core.joints[number].silent]
        core.disturbed(result.strays, len(missed), now_ns)
        for number in result.missed:
            core.missed(number)
        for number, status in result.inspected.items():
            core.inspected(number, status, now_ns)
        for number, as_set in result.checked.items():
            core.checked(number, as_set, now_ns)
        for task, position in result.done:
            core.done(task, position, now_ns)
        for task, why in result.refused:
            core.refused(task, why)
        for task in result.failed:
            core.again(task)
        self.orders.give(core.orders(now_ns))
        if now_ns and (state := core.state(now_ns)) is not None:
            self._node.publish(self._state, state)
        self.report_faults()
        self._changed.set()

    async def _asked(self, request: ServoRequest) -> ServoReply:
        core = self.core
        if unknown := core.unknown(request.joints):
            known = ", ".join(one.joint.name for one in core.joints.values())
            raise CocoroError(f"{self._node.name} has no joint {unknown[0]!r}; it has {known}")
        act = {"clear": core.clear, "relax": core.relax, "hold": core.hold}[request.action]
        names = act(request.joints)
        left = [name for name in names if not self._is_done(name, request.action)]
        try:
            async with asyncio.timeout(DONE_S):
                while left:
                    self._changed.clear()
                    await self._changed.wait()
                    left = [name for name in left if not self._is_done(name, request.action)]
        except TimeoutError:
            pass
        why = "; ".join(core.faults(self._node.now_ns())) or self.core.stopped_by
        text = f"{', '.join(left)}: not done{f', {why}' if why else ''}" if left else ""
        return ServoReply(joints=tuple(name for name in names if name not in left), text=text)

    def _is_done(self, name: str, action: str) -> bool:
        one = next(one for one in self.core.joints.values() if one.joint.name == name)
        return not one.enabled if action == "relax" else one.enabled

    def report_faults(self) -> None:
        core = self.core
        silent = "servos do not answer" if core.silent_joints() else ""
        degraded = "no line" if core.port_fault else silent
        self._reporter.report(core.faults(self._node.now_ns()), degraded=degraded)


class LineService:
    """One line: its thread, and the services of the groups with joints on it. Joints of no group are left alone."""

    def __init__(self, line: str, nodes: Mapping[Group, Node], config: ServosConfig) -> None:
        """`nodes`: by group on the line, its participant of the mesh; at least one."""
        self._groups = [GroupService(node, group) for group, node in nodes.items()]
        node = next(iter(nodes.values()))
        row = node.robot.networks[line]
        family = FAMILIES[row.protocol]
        joints = [one.joint for group in self._groups for one in group.core.joints.values()]
        settings = {joint.id: family.settings(joint, config.torque.get(joint.name, 1.0)) for joint in joints}
        port = port_path(config.port_of(line), node.robot_name)
        orders = [group.orders for group in self._groups]
        self._line = ServoLine(port, row.baud, family, settings, row.rate_hz, config.reply_s, self._on_cycle, orders)

    async def run(self) -> None:
        for group in self._groups:
            group.report_faults()
        self._line.start()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await self._line.stop()

    def _on_cycle(self, result: CycleResult) -> None:
        for group in self._groups:
            group.take(result.of(group.core.joints))
        self._give_task()

    def _give_task(self) -> None:
        """The line does one task in a cycle, so it is given one; the groups take turns."""
        for group in self._groups:
            if (task := group.core.next_task()) is not None:
                self._line.do(task)
                self._groups = [*(other for other in self._groups if other is not group), group]
                return


async def run(node: Node, config: ServosConfig) -> None:
    """Serve all groups for ever."""
    config.check(node.robot)
    async with AsyncExitStack() as stack:
        nodes = {group: await stack.enter_async_context(node.sibling(group)) for group in GROUPS}
        node.ready()
        async with asyncio.TaskGroup() as tasks:
            for line in node.robot.networks:
                if carried := {group: nodes[group] for group in node.robot.groups_on(line)}:
                    tasks.create_task(LineService(line, carried, config).run())


implementation = Implementation(ServosConfig, run)
