"""Commands that follow a task while the executive is not heard, dies, or comes back."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from follower_rig import REQUEST, Executive, Scene, following, in_virtual_time

from apps.cli import exits
from apps.cli.link import MeshLink
from apps.cli.progress import LineDisplay
from apps.cli.tasks import Follower
from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.errors import MeshError
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.vloop import run_virtual
from deploy.rundir import RunDir


class Claimed(Scene):
    """The executive is a process of this machine, which holds its claim."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        run_dir = RunDir("calliope", folder)
        (self.claim,) = run_dir.claim("executive", ["executive"])
        self.link = MeshLink(run_dir, self.mesh.join())

    def returns(self) -> Executive:
        """The executive, on the mesh again as it was before."""
        self.bus = self.mesh.join()
        self.node = Node("executive", self.bus, VirtualClock(), Robot.load())
        return Executive(self.node)


def with_claim(scenario: Callable[[Claimed], Awaitable[None]]) -> Callable[[Path], None]:
    def test(tmp_path: Path) -> None:
        async def run() -> None:
            scene = Claimed(tmp_path)
            async with scene.node:
                await scenario(scene)
            scene.claim.release()

        run_virtual(run())

    test.__name__ = scenario.__name__
    return test


@with_claim
async def test_an_executive_that_lives_and_is_not_met_is_not_called_missing(scene: Claimed) -> None:
    with pytest.raises(MeshError) as caught:
        await scene.follower().run()
    assert f"no contact with executive though its process {os.getpid()} lives" in str(caught.value)


@in_virtual_time
async def test_an_outcome_that_was_not_heard_is_asked_for_when_the_next_task_runs(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    executive.tell("search", 1.0)
    executive.knows("end", 4.0, outcome="done")
    for elapsed_s in (0.0, 0.2):
        executive.tell("search", elapsed_s, task_id="fetch-2")
    assert (await asyncio.wait_for(running, 1.0))[0] == exits.DONE


async def losing_contact(scene: Scene) -> asyncio.Task[tuple[int, dict[str, object]]]:
    """A follower whose task has been accepted by an executive that is not heard from now on."""
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    return running


@with_claim
async def test_when_the_executive_dies_so_does_the_task(scene: Claimed) -> None:
    running = await losing_contact(scene)
    scene.claim.release()
    code, result = await asyncio.wait_for(running, 1.0)
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "failed", "executive died")
    assert scene.out.getvalue() == "failed: fetch red_can: executive died\n"


@with_claim
async def test_an_executive_that_is_lost_and_heard_again_says_the_outcome_itself(scene: Claimed) -> None:
    running = await losing_contact(scene)
    await asyncio.sleep(5.0)
    executive = scene.returns()
    executive.tell("approach", 6.0)
    await asyncio.sleep(30.0)
    executive.tell("end", 40.0, outcome="done")
    code, _ = await running
    assert code == exits.DONE
    assert scene.out.getvalue().splitlines()[0] == "lost contact with executive: looking again"


@with_claim
async def test_an_executive_that_dies_while_it_is_not_heard_has_died(scene: Claimed) -> None:
    running = await losing_contact(scene)
    await asyncio.sleep(5.0)
    scene.claim.release()
    code, result = await asyncio.wait_for(running, 1.0)
    assert (code, result["reason"]) == (exits.FAILED, "executive died")


@in_virtual_time
async def test_of_an_executive_that_is_not_heard_any_more_it_is_not_said_that_it_died(scene: Scene) -> None:
    running = await losing_contact(scene)
    code, result = await asyncio.wait_for(running, 15.0)
    reason = "lost contact with executive; the task may still be running; see cocoro status"
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "unknown", reason)


@with_claim
async def test_an_executive_that_comes_back_without_the_task_is_not_waited_for(scene: Claimed) -> None:
    running = await losing_contact(scene)
    await asyncio.sleep(5.0)
    executive = scene.returns()
    executive.known.clear()
    executive.tell("", 0.0, task_id="")
    code, result = await asyncio.wait_for(running, 1.0)
    reason = "the executive was restarted meanwhile and does not know the task"
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "unknown", reason)


@with_claim
async def test_an_outcome_that_was_told_while_contact_was_lost_is_asked_for(scene: Claimed) -> None:
    running = await losing_contact(scene)
    await asyncio.sleep(5.0)
    executive = scene.returns()
    executive.knows("end", 9.0, outcome="done")
    executive.tell("search", 1.0, task_id="fetch-2")  # another's task runs by now
    assert (await asyncio.wait_for(running, 1.0))[0] == exits.DONE
    assert scene.out.getvalue().splitlines()[-1] == "done: fetch red_can in 9.0 s"


@with_claim
async def test_a_broken_session_is_replaced_by_another(scene: Claimed) -> None:
    """The executive goes on, and is heard by everybody but this command."""
    Executive(scene.node)

    @asynccontextmanager
    async def rejoin() -> AsyncIterator[MeshLink]:
        yield MeshLink(scene.link.run_dir, other.join())

    follower = Follower(scene.link, REQUEST, LineDisplay(scene.out), None, rejoin=rejoin)
    running = await following(follower)
    other = LocalMesh()
    scene.bus.kill()
    node = Node("executive", other.join(), VirtualClock(), Robot.load())
    executive = Executive(node)
    executive.tell("approach", 2.0)
    await asyncio.sleep(3.0)
    executive.tell("end", 5.0, outcome="failed", reason="blocked")
    code, result = await asyncio.wait_for(running, 1.0)
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "failed", "blocked")


@in_virtual_time
async def test_when_no_news_arrives_the_executive_is_asked(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    executive.knows("end", 3.0, outcome="done")
    assert (await asyncio.wait_for(running, 6.0))[0] == exits.DONE
