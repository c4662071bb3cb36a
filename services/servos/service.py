"""The services of both servo networks: for each, a thread talks to the line, and a pure core decides."""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro import topics
from cocoro.component import Implementation
from cocoro.errors import CocoroError, ConfigError
from cocoro.faults import FaultReporter
from cocoro.latch import ServiceLatch
from cocoro.messages import LatchState, ServoCommand, ServoReply, ServoRequest, ServoState
from cocoro.node import Node
from cocoro.ports import port_path
from cocoro.topics import Topic
from cocoro.units import PositiveShare
from services.servos.families import FAMILIES
from services.servos.line import CycleResult, ServoLine
from services.servos.network import ServoNetwork

NETWORKS: dict[str, tuple[Topic[ServoState], Topic[ServoCommand]]] = {
    "arm": (topics.ARM_STATE, topics.ARM_COMMAND),
    "hand": (topics.HAND_STATE, topics.HAND_COMMAND),
}
DONE_S = 2.0


class ServosConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    arm_port: str = "/dev/cocoro-arm"
    """The serial port of neck and arm: a device, or wire:NAME for an emulated one."""
    hand_port: str = "/dev/cocoro-hand"
    reply_s: Annotated[float, Meta(gt=0, le=0.5)] = 0.03
    """Time limit for a servo's answer."""
    torque: dict[str, PositiveShare] = {}
    """By joint, the share of its stall torque that it may push with; by default all of it."""


class NetworkService:
    """One network: a line with its thread, and a participant of the mesh."""

    def __init__(self, node: Node, config: ServosConfig) -> None:
        self._node = node
        self._reporter = FaultReporter(node)
        robot = node.robot
        joints = [robot.joints[name] for name in robot.network_joints(node.name)]
        keeps_goal = node.name == "hand"
        row = robot.networks[node.name]
        self._state, command = NETWORKS[node.name]
        family = FAMILIES[row.protocol]
        self._network = ServoNetwork(
            joints, family, keeps_goal=keeps_goal, timeout_s=row.command_timeout_s, max_age_s=command.max_age_s
        )
        settings = {joint.id: family.settings(joint, config.torque.get(joint.name, 1.0)) for joint in joints}
        port = port_path(config.arm_port if node.name == "arm" else config.hand_port, node.robot_name)
        self._line = ServoLine(
            port, row.baud, family, settings, row.rate_hz, config.reply_s, self._on_cycle, keeps_goal
        )
        self._epoch = node.clock.epoch
        self._changed = asyncio.Event()
        ServiceLatch(node, self._latched, self._line.halt)
        node.on(command, self._commanded)
        node.serve(topics.SERVOS.of(node.name), self._asked)

    async def run(self) -> None:
        self._report_faults()
        self._line.start()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await self._line.stop()

    def _commanded(self, command: ServoCommand) -> None:
        now_ns = self._node.now_ns()
        self._network.command(command, now_ns)
        self._line.order(self._network.orders(now_ns))

    def _latched(self, state: LatchState, by: str) -> None:
        self._network.set_latch(state)
        self._line.order(self._network.orders(self._node.now_ns()))
        self._line.go_on()  # these orders know of the latch

    def _on_cycle(self, result: CycleResult) -> None:
        """Take the results of a cycle. The line's thread goes by the monotonic clock, the network by the robot's."""
        network, now_ns = self._network, self._node.now_ns()
        if self._node.clock.epoch != self._epoch:
            self._epoch = self._node.clock.epoch
            network.new_epoch()
        monotonic_ns = time.monotonic_ns()
        network.port_fault = result.port_fault
        if result.port_fault:
            network.port_lost(result.port_fault)
        for number, reading in result.readings.items():
            network.read(number, reading, now_ns - max(monotonic_ns - reading.at_ns, 0))
        missed = [number for number in result.missed if not network.joints[number].silent]
        network.disturbed(result.strays, len(missed), now_ns)
        for number in result.missed:
            network.missed(number)
        for number, status in result.inspected.items():
            network.inspected(number, status, now_ns)
        for number, as_set in result.checked.items():
            network.checked(number, as_set, now_ns)
        for task, position in result.done:
            network.done(task, position, now_ns)
        for task, why in result.refused:
            network.refused(task, why)
        for task in result.failed:
            network.again(task)
        if (next_task := network.next_task()) is not None:
            self._line.do(next_task)
        self._line.order(network.orders(now_ns))
        if now_ns and (state := network.state(now_ns)) is not None:
            self._node.publish(self._state, state)
        self._report_faults()
        self._changed.set()

    async def _asked(self, request: ServoRequest) -> ServoReply:
        network = self._network
        if unknown := network.unknown(request.joints):
            known = ", ".join(one.joint.name for one in network.joints.values())
            raise CocoroError(f"{self._node.name} has no joint {unknown[0]!r}; it has {known}")
        act = {"clear": network.clear, "relax": network.relax, "hold": network.hold}[request.action]
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
        why = "; ".join(network.faults(self._node.now_ns())) or self._network.stopped_by
        text = f"{', '.join(left)}: not done{f', {why}' if why else ''}" if left else ""
        return ServoReply(joints=tuple(name for name in names if name not in left), text=text)

    def _is_done(self, name: str, action: str) -> bool:
        one = next(one for one in self._network.joints.values() if one.joint.name == name)
        return not one.enabled if action == "relax" else one.enabled

    def _report_faults(self) -> None:
        network = self._network
        silent = "servos do not answer" if network.silent_joints() else ""
        degraded = "no line" if network.port_fault else silent
        self._reporter.report(network.faults(self._node.now_ns()), degraded=degraded)


async def run(node: Node, config: ServosConfig) -> None:
    """Serve both networks for ever."""
    unknown = sorted(set(config.torque) - set(node.robot.joints))
    if unknown:
        raise ConfigError(f"[service.servos] torque: the robot has no joint {unknown[0]!r}")
    async with AsyncExitStack() as stack:
        nodes = [await stack.enter_async_context(node.sibling(name)) for name in NETWORKS]
        node.ready()
        async with asyncio.TaskGroup() as group:
            for one in nodes:
                group.create_task(NetworkService(one, config).run())


implementation = Implementation(ServosConfig, run)
