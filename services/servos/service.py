"""The services of the servo groups: for each line, a thread talks to it, and for each group a pure core decides."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import AsyncExitStack
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro import topics
from cocoro.component import Implementation
from cocoro.errors import ConfigError, choice_of
from cocoro.joints import GROUPS, KEEPS_GOAL, Group
from cocoro.latch import ServiceLatch
from cocoro.messages import LatchState, ServoCommand, ServoState
from cocoro.node import Node
from cocoro.ports import port_path
from cocoro.robot import Robot
from cocoro.topics import Topic
from cocoro.units import PositiveShare
from services.servos.cycle import CycleResult
from services.servos.families import FAMILIES
from services.servos.group import ServoGroup
from services.servos.line import ServoLine
from services.servos.orders import GroupOrders
from services.servos.serving import LineParticipant
from services.servos.wheel_service import WheelService

TOPICS: dict[Group, tuple[Topic[ServoState], Topic[ServoCommand]]] = {
    "arm": (topics.ARM_STATE, topics.ARM_COMMAND),
    "hand": (topics.HAND_STATE, topics.HAND_COMMAND),
}


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


class GroupService(LineParticipant):
    """One group: a participant of the mesh, whose core decides what the servos of its joints do."""

    def __init__(self, node: Node, group: Group) -> None:
        super().__init__(node)
        robot, keeps_goal = node.robot, group in KEEPS_GOAL
        joints = [robot.joints[name] for name in robot.group_joints(group)]
        row = robot.networks[robot.line_of(group)]
        self._state, command = TOPICS[group]
        self.core: ServoGroup = ServoGroup(
            joints,
            FAMILIES[row.protocol],
            keeps_goal=keeps_goal,
            timeout_s=row.command_timeout_s,
            max_age_s=command.max_age_s,
        )
        self.orders = GroupOrders(keeps_goal=keeps_goal)
        ServiceLatch(node, self._latched, self.orders.halt)
        node.on(command, self._commanded)

    def _commanded(self, command: ServoCommand) -> None:
        now_ns = self._node.now_ns()
        self.core.command(command, now_ns)
        self._order(now_ns)

    def _latched(self, state: LatchState, by: str) -> None:
        self.core.set_latch(state)
        self._order(self._node.now_ns())
        self.orders.go_on()  # these orders know of the latch

    def _order(self, now_ns: int) -> None:
        self.orders.give(self.core.orders(now_ns))

    def _publish(self, now_ns: int) -> None:
        if (state := self.core.state(now_ns)) is not None:
            self._node.publish(self._state, state)


class LineService:
    """One line: its thread, and the services of the groups and wheels on it. Joints of no group are left alone."""

    def __init__(self, line: str, nodes: Mapping[Group, Node], config: ServosConfig, base: Node | None = None) -> None:
        """`nodes`: by group on the line, its participant of the mesh; `base`: that of the wheels, if their servos are
        on the line and this process drives them. One of them at least."""
        groups = [GroupService(node, group) for group, node in nodes.items()]
        node = (*nodes.values(), base)[0]
        assert node is not None
        row = node.robot.networks[line]
        family = FAMILIES[row.protocol]
        joints = [one.joint for group in groups for one in group.core.joints.values()]
        settings = {joint.id: family.settings(joint, config.torque.get(joint.name, 1.0)) for joint in joints}
        port = port_path(config.port_of(line), node.robot_name)
        self._wheels = None if base is None else WheelService(base, port, row)
        wheels = None if self._wheels is None else self._wheels.orders
        settings |= {number: dict(family.wheel_settings) for number in (wheels.numbers if wheels else ())}
        self._parts: list[LineParticipant] = [*groups, *([self._wheels] if self._wheels else [])]
        orders = [group.orders for group in groups]
        self._line = ServoLine(
            port, row.baud, family, settings, row.rate_hz, config.reply_s, self._on_cycle, orders, wheels
        )

    async def run(self) -> None:
        for part in self._parts:
            part.report_faults()
        async with AsyncExitStack() as stack:
            if self._wheels is not None:
                await stack.enter_async_context(self._wheels.guard)  # it ends when the line has stopped the wheels
            self._line.start()
            try:
                if self._wheels is not None:
                    await self._wheels.watch()
                await asyncio.get_running_loop().create_future()
            finally:
                await self._line.stop()

    def _on_cycle(self, result: CycleResult) -> None:
        for part in self._parts:
            part.take(result)
        self._give_task()

    def _give_task(self) -> None:
        """The line does one task in a cycle, so it is given one; its services take turns."""
        for part in self._parts:
            if (task := part.core.next_task()) is not None:
                self._line.do(task)
                self._parts = [*(other for other in self._parts if other is not part), part]
                return


async def serve(node: Node, config: ServosConfig, base: Node | None = None) -> None:
    """Serve all groups for ever, and with `base` the wheels, whose servos are on one of the lines."""
    config.check(node.robot)
    async with AsyncExitStack() as stack:
        nodes = {group: await stack.enter_async_context(node.sibling(group)) for group in GROUPS}
        node.ready()
        async with asyncio.TaskGroup() as tasks:
            for line in node.robot.networks:
                carried = {group: nodes[group] for group in node.robot.groups_on(line)}
                wheels = base if line == node.robot.wheel_line else None
                if carried or wheels is not None:
                    tasks.create_task(LineService(line, carried, config, wheels).run())


async def run(node: Node, config: ServosConfig) -> None:
    """Serve all groups for ever."""
    await serve(node, config)


implementation = Implementation(ServosConfig, run)
