"""Runs the policy that the intent wants: observes, has it act in a thread, and publishes what it proposes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

from cocoro.clock import is_fresh
from cocoro.component import Implementation
from cocoro.features import JOINT_STATES
from cocoro.messages import Intent, Message, PolicyActions
from cocoro.messages.actions import FollowPolicy
from cocoro.node import Node
from cocoro.policy import Policy, PolicyError
from cocoro.topics import BASE_STATE, FRAME, INTENT, POLICY_ACTIONS, Topic
from services.policy.config import PolicyServiceConfig
from services.policy.loading import Policies
from services.policy.observing import Observed, Observer
from services.policy.proposing import proposal, refusal

T = TypeVar("T")
REPEAT_S = 0.2
"""A refusal and an end are told again after this time, since a message may be lost."""


class _Wanted(NamedTuple):
    """A run of a policy."""

    task_id: str
    step: int
    name: str


class Runner:
    """One policy at a time. All but its `act` runs on the event loop."""

    def __init__(self, node: Node, config: PolicyServiceConfig) -> None:
        self._node = node
        self._config = config
        self.policies = Policies(node.robot, config)
        self._thread = ThreadPoolExecutor(1, "policy")
        self._wanted: _Wanted | None = None
        self._intent_ns = 0
        self._observer: Observer | None = None
        self._observed: Observed | None = None
        """The newest observation that no policy has seen."""
        self._misfit = ""
        self._news = asyncio.Event()
        node.on(INTENT, self._on_intent)
        topics: tuple[Topic[Any], ...] = (FRAME, BASE_STATE, *JOINT_STATES)
        for topic in topics:
            node.inbox(topic).add(self._reader(topic))

    async def run(self) -> None:
        try:
            while True:
                await self._until_news()
                if (wanted := self._current()) is not None:
                    await self._carry_out(wanted)
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)

    # --- what arrives -----------------------------------------------------------------------------

    def _on_intent(self, intent: Intent) -> None:
        action = intent.action
        wanted = _Wanted(intent.task_id, intent.step, action.label) if isinstance(action, FollowPolicy) else None
        self._intent_ns = intent.stamp_ns
        if wanted != self._wanted:
            self._wanted = wanted
            self._news.set()

    def _reader(self, topic: Topic[Any]) -> Callable[[str, Message], None]:
        def take(_key: str, message: Message) -> None:
            if self._observer is None:
                return
            try:
                observed = self._observer.take(topic, message, self._node.now_ns())
            except PolicyError as error:
                self._misfit = str(error)
                self._news.set()
                return
            if observed is not None:
                self._observed = observed
                self._news.set()

        return take

    def _current(self) -> _Wanted | None:
        """The run that is wanted now; None when the executive has fallen silent, too."""
        fresh = is_fresh(self._intent_ns, self._node.now_ns(), INTENT.max_age_s)
        return self._wanted if fresh else None

    async def _until_news(self) -> None:
        await self._news.wait()
        self._news.clear()

    # --- a run ------------------------------------------------------------------------------------

    async def _carry_out(self, wanted: _Wanted) -> None:
        """Run a policy until another intent comes."""
        try:
            await self._propose(wanted)
        except PolicyError as error:
            self._node.log.warning("%s: %s", wanted.name, error)
            await self._repeat(refusal(str(error), wanted.task_id, wanted.step), wanted)
        finally:
            self._observer = self._observed = None
        if self._wanted is not None and self._wanted != wanted:
            self._news.set()

    async def _propose(self, wanted: _Wanted) -> None:
        """Raises PolicyError when the policy cannot go on."""
        node = self._node
        policy = await self._called(lambda: self.policies.load(wanted.name))
        await self._called(policy.reset)
        self._misfit = ""
        self._observer = Observer(node.robot, policy.features, self._config.state_wait_s)
        while self._wanted == wanted:
            await self._until_news()
            if self._misfit:
                raise PolicyError(f"policy {wanted.name}: {self._misfit}")
            observed, self._observed = self._observed, None
            if observed is None or self._current() != wanted:
                continue
            message = await self._acted(policy, observed, wanted)
            if self._wanted != wanted:
                return
            if message.state == "done":
                await self._repeat(message, wanted)
                return
            node.publish(POLICY_ACTIONS, message)

    async def _acted(self, policy: Policy, observed: Observed, wanted: _Wanted) -> PolicyActions:
        actions = await self._called(lambda: policy.act(observed.content))
        if self._node.clock.virtual:
            await self._node.sleep(self._config.virtual_s)
        try:
            return proposal(actions, observed, policy.features, self._node.robot, wanted.task_id, wanted.step)
        except PolicyError as error:
            raise PolicyError(f"policy {wanted.name}: {error}") from error

    async def _called(self, call: Callable[[], T]) -> T:
        """Have the thread call something of a policy. In virtual time, which does not wait for threads, it is called
        here. Raises PolicyError when it fails."""
        try:
            if self._node.clock.virtual:
                return call()
            return await asyncio.get_running_loop().run_in_executor(self._thread, call)
        except PolicyError:
            raise
        except Exception as error:  # a third party's code
            self._node.log.exception("a policy failed")
            raise PolicyError(f"the policy failed: {type(error).__name__}: {error}") from error

    async def _repeat(self, message: PolicyActions, wanted: _Wanted) -> None:
        while self._wanted == wanted:
            self._node.publish(POLICY_ACTIONS, message)
            await self._node.sleep(REPEAT_S)


async def run(node: Node, config: PolicyServiceConfig) -> None:
    """Run policies for ever."""
    runner = Runner(node, config)
    names = runner.policies.names()
    node.ready(f"policies: {', '.join(names)}" if names else "no policies are listed")
    await runner.run()


implementation = Implementation(PolicyServiceConfig, run)
