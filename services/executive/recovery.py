"""What becomes of a running task when a service dies or contact with it is lost: the policies, and the waiting.

The robot stands, arm and hand hold what they hold, until the service is back; then the interrupted step begins anew
from where that is safe. A network link that is cut looks the same from here: the tokens of all services beyond it drop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

from cocoro.clock import NS
from cocoro.messages.actions import (
    ACTIONS,
    Action,
    Approach,
    BabbleArm,
    BabbleWheels,
    Carry,
    Drive,
    Follow,
    GoTo,
    PutDown,
    Reach,
    Touch,
)
from cocoro.node import Node
from services.executive.config import ExecutiveConfig
from services.executive.skills import PlannerSkills

Resume = Literal["on", "again", "find", "approach", "holding", "never"]
"""What an action does when a service was lost meanwhile and is back, the least demanding first:
on: it goes on meanwhile, for it does without the service; again: it begins anew; find: its object is found again first,
unless it was seen just now; approach: and approached again; holding: it begins anew if the hand holds something, else
the task fails; never: the task fails at once."""
_ORDER: tuple[Resume, ...] = ("on", "again", "find", "approach", "holding", "never")

LOOK_S = 0.02
"""Time between two looks whether a service is back or has died."""
SETTLE_S = 0.5
"""Time for which a planner must say that it could move before a task goes on. A new planner needs half of it to feel
what the hand holds."""
STARTING = 3
"""For a service whose new process is there, but not ready yet, it waits so many times as long."""
STANDING_CLOCK = 3
"""A wait is at most so many times as long by the machine's clock as by the robot's, which may stand."""


class Policy(NamedTuple):
    """The row of a table. Empty fields mean any."""

    services: tuple[str, ...]
    actions: tuple[type[Action], ...]
    resume: Resume


POLICIES = (
    Policy(("perception", "kinect"), (PutDown, Drive), "on"),  # by hand: arm and head move, the wheels stand
    # The count of draws and trials, and the place under the hand, were in the planner that died.
    Policy(("planning",), (Touch, BabbleArm, BabbleWheels), "never"),
    Policy((), (Approach, GoTo, Follow), "find"),
    Policy((), (Reach,), "approach"),
    # With an empty hand, putting down has let go already, and would go back to where the object stands.
    Policy((), (Carry, PutDown), "holding"),
)
"""The first row that fits decides. Without one the action begins anew; but a third party's, of which nothing is known,
not with another planner."""


def policy(service: str, action: Action) -> Resume:
    """What the loss of a service means to an action."""
    for row in POLICIES:
        if (not row.services or service in row.services) and (not row.actions or isinstance(action, row.actions)):
            return row.resume
    ours = type(action) in ACTIONS.own.values()
    return "again" if ours or service != "planning" else "never"


def strictest(services: Iterable[str], action: Action) -> Resume:
    """What the loss of all these services means to an action."""
    return max((policy(service, action) for service in services), key=_ORDER.index, default="on")


class Recovery:
    """Waits for the services that one task has lost. `end` ends the task as failed, for a reason."""

    def __init__(
        self,
        node: Node,
        config: ExecutiveConfig,
        skills: PlannerSkills,
        alive: set[str],
        end: Callable[[str], None],
    ) -> None:
        """`alive`: the services that are heard now, kept up to date by the caller."""
        self._node = node
        self._config = config
        self._skills = skills
        self._alive = alive
        self._end = end
        self._unheard: dict[str, str] = {}
        """By service that is waited for: what is known of it."""
        self._dead: set[str] = set()
        self._lost: set[str] = set()
        """All services that were lost since the task went on last."""
        self._times = 0
        self._began_ns, self._began_s = 0, 0.0
        self._waiting: asyncio.Task[Any] | None = None
        self._away = 0

    @property
    def text(self) -> str:
        """What the task waits for, for people; '' when it does not."""
        if dead := [service for service in self._unheard if service in self._dead]:
            names, many = ", ".join(dead), len(dead) > 1
            back = "they are" if many else "it is"
            return f"waiting for {names}, which died; {back} back in a moment"
        if self._unheard:
            return self._why
        return "going on in a moment" if self._skills.paused else ""

    @property
    def died(self) -> str:
        """The reason of a task that a new clock ends after the death of a simulator; '' without a death."""
        dead = sorted(self._lost & self._dead)
        return f"not_alive: {dead[0]} died" if dead else ""

    @property
    def _why(self) -> str:
        """What is known of the services that are not heard: the same of all, or of the first."""
        whys = list(self._unheard.values())
        if all(why == f"lost contact with {service}" for service, why in self._unheard.items()):
            return f"lost contact with {', '.join(sorted(self._unheard))}"
        return whys[0]

    @contextmanager
    def away(self) -> Iterator[None]:
        """Within this context the robot stands, whoever is heard."""
        self._away += 1
        self._skills.pause()
        try:
            yield
        finally:
            self._away -= 1

    async def cut_off(self, within_s: float) -> bool:
        """Whether a service is not heard that is not on this machine, as far as is known, now or after this time. If
        so, returns when all are heard again."""
        await asyncio.sleep(within_s)
        if all(self._node.contact.lives(service) for service in self._unheard.keys() - self._dead):
            return False
        while self._unheard:  # noqa: ASYNC110 # ended by `_wait`
            await asyncio.sleep(LOOK_S)
        return True

    def lost(self, service: str) -> None:
        """A needed service's token dropped."""
        begins = self._waiting is None or self._waiting.done()
        if begins:
            self._lost.clear()
            self._dead.clear()
        self._times += begins or service in self._lost
        self._lost.add(service)
        self._dead.discard(service)
        self._unheard[service] = f"lost contact with {service}"
        self._renew()
        resume = policy(service, self._skills.action)
        if resume != "on":
            self._skills.pause()
        fatal = resume == "never" or self._times > self._config.resumptions
        self._node.spawn(self._find_out(service, fatal))
        if begins and not fatal:
            self._waiting = self._node.spawn(self._wait())

    def step_begins(self, action: Action) -> None:
        """The task wants a new action: it waits when that does not go on without a service that is not heard."""
        if self._unheard and strictest(self._unheard, action) != "on":
            self._skills.pause()

    def close(self) -> None:
        """The task has ended."""
        if self._waiting is not None:
            self._waiting.cancel()
        self._unheard.clear()

    async def _find_out(self, service: str, fatal: bool) -> None:
        """Find out whether a service died. `fatal`: the task ends then."""
        why = await self._node.contact.lost(service)
        if service in self._unheard:
            self._note(service, why)
        self._node.log.warning("%s", why)
        if fatal:
            often = f", after {self._times - 1} interruptions" if self._times > self._config.resumptions else ""
            self._end(f"not_alive: {why}{often}")

    def _note(self, service: str, why: str) -> None:
        self._unheard[service] = why
        if self._node.contact.dead(service) and service not in self._dead:
            self._dead.add(service)
            self._renew()  # it is being restarted from now on

    def _renew(self) -> None:
        self._began_ns, self._began_s = self._node.now_ns(), asyncio.get_running_loop().time()

    def _over(self) -> bool:
        """Whether it was waited for long enough: by the robot's time, for a starved machine is slow."""
        dead = self._unheard.keys() & self._dead
        wait_s = self._config.contact_s
        if dead and all(self._node.contact.starting(service) for service in dead):
            wait_s *= STARTING
        if asyncio.get_running_loop().time() - self._began_s >= STANDING_CLOCK * wait_s:
            return True
        # Where a simulator makes the time, a dead part of it means that the world has ended.
        gone = self._node.clock.stands and bool(dead)
        return gone or self._node.now_ns() - self._began_ns >= wait_s * NS

    async def _wait(self) -> None:
        """Wait until all are heard again and the planner could move, then have the task go on; end the task when that
        takes too long."""
        contact = self._node.contact
        while True:
            for service in list(self._unheard):
                if service in self._alive:
                    del self._unheard[service]
                    self._renew()
                elif service not in self._dead and contact.dead(service):
                    self._note(service, f"{service} died")
            if self._unheard and self._over():
                self._end(f"not_alive: {self._why}")
                return
            ready = not self._unheard and not self._away
            if ready and (not self._skills.paused or self._skills.settled(SETTLE_S) or self._over()):
                break
            await asyncio.sleep(LOOK_S)
        if self._skills.paused:
            self._node.log.info("%s: back, the task goes on", ", ".join(sorted(self._lost)))
            lost = frozenset(self._lost)
            self._skills.go_on(lambda action: strictest(lost, action), f"not_alive: {self._reason()}")

    def _reason(self) -> str:
        """What happened, for a task that cannot go on after it."""
        lost = sorted(self._lost)
        return ", ".join(f"{one} died" if one in self._dead else f"lost contact with {one}" for one in lost)
