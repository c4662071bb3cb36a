"""A policy sees what the export writes: the rows of a capture's dataset equal the observations at the same times."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import policy_rig
from capture_rig import Room, record
from lerobot_rig import WHOLE, run
from spelled import action

from apps.captures.export.lerobot_episodes import Recording, recorded_tasks
from cocoro import topics
from cocoro.capture.tables import Tables
from cocoro.component import load
from cocoro.features import PICTURES, STATE, PolicyFeatures
from cocoro.messages import Intent, PolicyActions
from cocoro.robot import Robot
from deploy.processes import named
from services.policy.config import PolicyServiceConfig

WIDTH, HEIGHT = 16, 12


class Looking(policy_rig.Fixed):
    """Looks at every picture, at the rate of the camera."""

    last: Looking

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        names = self.features.state
        self.features = PolicyFeatures(state=names, action=names, rate_hz=10.0, chunk=10, every=1, width=16, height=12)
        Looking.last = self


def test_the_rows_of_the_export_are_the_observations_of_the_policy(tmp_path: Path) -> None:
    proposed: list[PolicyActions] = []

    async def scenario(room: Room) -> None:
        async with room.node("policy") as node, room.node("asker") as asker:
            asker.on(topics.POLICY_ACTIONS, proposed.append)
            config = PolicyServiceConfig(policies={"looking": f"{__name__}:Looking"})
            service = asyncio.ensure_future(load(named("policy")).run(node, config))

            async def ask() -> None:
                while True:
                    asker.publish(topics.INTENT, Intent(task_id="t", step=1, action=action("policy", "looking")))
                    await asyncio.sleep(0.02)

            asking = asyncio.ensure_future(ask())
            await run(room, (WHOLE,))
            for work in (asking, service):
                work.cancel()
            await asyncio.gather(asking, service, return_exceptions=True)

    path = record(tmp_path / "run.mcap", scenario)
    seen = dict(zip((message.observed_ns for message in proposed), Looking.last.seen, strict=False))
    with Tables.open(path) as capture:
        recording = Recording(capture, Robot.load())
        episode = recording.episode(recorded_tasks(capture)[0], 10)
        pictures = [picture.copy() for picture in recording.pictures(episode)]
    stamps = episode.pictures_ns.tolist()
    assert len(stamps) > 15
    assert set(stamps) <= set(seen)
    for stamp_ns, state, picture in zip(stamps, episode.state, pictures, strict=True):
        assert np.array_equal(seen[stamp_ns][STATE], state)
        assert seen[stamp_ns][STATE].dtype == state.dtype
        assert np.array_equal(seen[stamp_ns][PICTURES], picture)
