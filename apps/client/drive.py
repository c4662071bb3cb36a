"""Driving by hand from a program: a motion lasts as long as the program asks for it, and no longer."""

from __future__ import annotations

import asyncio

from apps.client.handle import TaskHandle
from cocoro.driving import Driving
from cocoro.messages import DriveReply, Motion
from cocoro.messages.driving import HOLD_S

RENEW_S = HOLD_S / 4
"""A motion is renewed so often; a loop that is late by less than the rest of `HOLD_S` does not stop the robot."""


class Drive:
    """The robot in a program's hand, from `RobotClient.drive`. It comes to rest when the program says nothing for
    0.2 s, is killed, or is cut off."""

    def __init__(self, driving: Driving, task: TaskHandle) -> None:
        self.task = task
        """The task `drive`."""
        self._driving = driving

    @property
    def motion(self) -> Motion:
        """What is asked for now. Set it again at least every 0.2 s; `Motion()` is rest at once."""
        return self._driving.motion

    @motion.setter
    def motion(self, wanted: Motion) -> None:
        self._driving.motion = wanted

    @property
    def reply(self) -> DriveReply:
        """The robot's last answer: whether the motion counts, and why not."""
        return self._driving.reply

    async def move(self, motion: Motion, for_s: float) -> None:
        """Asks for a motion for some seconds, then for rest. Raises TaskEndedError when the task ends meanwhile."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + for_s
        try:
            while (left_s := end_s - loop.time()) > 0:
                if self._driving.over.is_set() or self.task.done:
                    await self.task  # says how it ended
                    return
                self._driving.motion = motion
                await asyncio.sleep(min(RENEW_S, left_s))
        finally:
            self._driving.motion = Motion()
