"""Commands that are interrupted, or lose their terminal, while they follow a task: it is cancelled on the robot."""

from __future__ import annotations

import asyncio
import errno
import signal

from follower_rig import ID, REQUEST, Executive, Scene, following, in_virtual_time

from apps.cli import exits
from apps.cli.babble import SampleWriter
from apps.cli.progress import LineDisplay
from apps.cli.tasks import Follower
from cocoro.keys import asker_key
from cocoro.messages import (
    Message,
)


class Vanished(LineDisplay):
    """A terminal that is no more: it raises whatever is written."""

    def say(self, text: str) -> None:
        raise OSError(errno.EIO, "Input/output error")


@in_virtual_time
async def test_the_first_interrupt_cancels_on_the_robot_and_waits_for_the_outcome(scene: Scene) -> None:
    executive = Executive(scene.node)
    executive.on_cancel = lambda: executive.tell("end", 2.0, outcome="cancelled", reason="by the operator")
    follower = scene.follower()
    running = await following(follower)
    follower.signalled(signal.SIGINT)
    code, _ = await running
    assert (code, executive.cancelled) == (exits.REFUSED, [ID])
    assert scene.out.getvalue().splitlines()[-1] == "cancelled: fetch red_can after 2.0 s: by the operator"


@in_virtual_time
async def test_babbling_that_cannot_be_kept_is_cancelled_on_the_robot(scene: Scene) -> None:
    """The robot would move for nothing."""

    class Full:
        taken = 0

        def take(self, _message: Message) -> None:
            self.taken += 1
            raise OSError(errno.ENOSPC, "No space left on device")

    executive = Executive(scene.node)
    executive.on_cancel = lambda: executive.tell("end", 2.0, outcome="cancelled")
    follower, full = scene.follower(), Full()
    writer = SampleWriter(full, follower.cancel)  # type: ignore[arg-type]
    running = await following(follower)
    writer.take(Message())
    writer.take(Message())
    assert (await running)[0] == exits.REFUSED
    assert executive.cancelled == [ID]
    assert full.taken == 1
    assert writer.failure is not None


@in_virtual_time
async def test_of_an_interrupt_before_the_request_the_robot_hears_nothing(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    follower.signalled(signal.SIGINT)
    code, result = await follower.run()
    assert (code, result["outcome"], executive.asked) == (exits.REFUSED, "cancelled", [])
    assert scene.out.getvalue() == "cancelled: fetch red_can before it began\n"


@in_virtual_time
async def test_an_interrupt_before_the_robot_has_answered_cancels_as_soon_as_it_has(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    executive.on_run = lambda: follower.signalled(signal.SIGTERM)
    executive.on_cancel = lambda: executive.tell("end", 0.1, outcome="cancelled")
    assert (await follower.run())[0] == exits.REFUSED
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_the_second_interrupt_leaves_without_the_outcome_and_says_so(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    running = await following(follower)
    follower.signalled(signal.SIGINT)
    await asyncio.sleep(1.0)
    assert not running.done()
    follower.signalled(signal.SIGINT)
    code, result = await asyncio.wait_for(running, 0.1)
    assert (code, result["outcome"], result["task_id"]) == (exits.REFUSED, None, ID)
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_the_signals_of_a_terminal_that_is_closed_are_one_end(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    running = await following(follower)
    for _ in range(2):
        follower.cancel()  # its output has no reader any more
        follower.signalled(signal.SIGHUP)
    await asyncio.sleep(1.0)
    executive.tell("end", 2.0, outcome="cancelled", reason="by the operator")
    assert (await running)[0] == exits.REFUSED
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_the_task_is_cancelled_before_anything_is_written(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower(Vanished(scene.out))
    running = await following(follower)
    follower.signalled(signal.SIGHUP)
    await asyncio.sleep(0.1)
    assert executive.cancelled == [ID]
    running.cancel()


@in_virtual_time
async def test_a_request_names_an_asker_whose_token_lives_as_long_as_the_task_is_followed(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    key = asker_key("calliope", executive.asked[0].asker)
    assert scene.mesh.tokens[key] == 1
    executive.tell("end", 9.5, outcome="done")
    await running
    assert scene.mesh.tokens[key] == 0


@in_virtual_time
async def test_a_detached_task_that_is_let_go_of_before_the_answer_is_cancelled_however_often(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = Follower(scene.link, REQUEST, LineDisplay(scene.out), None, watched=False)

    def three_times() -> None:
        for _ in range(3):
            follower.signalled(signal.SIGINT)

    executive.on_run = three_times
    code, result = await follower.ask()
    assert (code, result["outcome"], executive.cancelled) == (exits.REFUSED, "cancelled", [ID])


@in_virtual_time
async def test_a_task_that_does_not_end_when_cancelled_points_to_the_emergency_stop(scene: Scene) -> None:
    Executive(scene.node)
    follower = scene.follower()
    running = await following(follower)
    follower.signalled(signal.SIGINT)
    await asyncio.sleep(11.0)
    assert "cocoro estop" in scene.out.getvalue().splitlines()[-1]
    running.cancel()
