"""Recording and replaying over zenoh with processes: what remains after a kill, and that no living service is
impersonated."""

from __future__ import annotations

import asyncio
import json
import os
import random
import select
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from capture_rig import STILL, all_of, drive, record

from apps.captures.info import report
from apps.captures.rewrite import rewrite
from apps.cli import capture as capture_command
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.capture.reader import Capture
from cocoro.clock import NS, RealClock
from cocoro.keys import recorder_key
from cocoro.messages import BaseState
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import RunDir
from services.capture.config import CaptureConfig
from services.capture.log_clock import WALL_CLOCK, LogClock
from services.capture.packing import Packer
from services.capture.service import run

pytestmark = pytest.mark.zenoh

ROBOT = "calliope"
KILLS = 5
"""`python -m bench capture kill --times 20` does 20 and prints the figures."""
MISSING_S = 0.3
PATIENCE_S = 60.0


class Pulse:
    """A base that publishes its state continuously, and measures how late this machine lets it."""

    def __init__(self, node: Node) -> None:
        self.stall_s = 0.0
        self._node = node

    async def beat(self) -> None:
        tick = 0
        while True:
            self._node.publish(topics.BASE_STATE, BaseState(odometry_m=(float(tick), 0.0), **STILL))
            tick += 1
            began_s = time.monotonic()
            await asyncio.sleep(0.005)
            self.stall_s = max(self.stall_s, time.monotonic() - began_s)


@asynccontextmanager
async def robot(run_dir: Path) -> AsyncIterator[tuple[ZenohBus, Pulse]]:
    async with (
        await ZenohBus.open(default(ROBOT, "test", run_dir)) as bus,
        Node("base", bus, RealClock(), Robot.load()) as node,
    ):
        node.ready()
        pulse = Pulse(node)
        beating = asyncio.create_task(pulse.beat())
        yield bus, pulse
        beating.cancel()


async def cocoro(run_dir: Path, *arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "apps.cli.main", *arguments,
        env=os.environ | {"COCORO_RUN_DIR": str(run_dir)},
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip


async def heard_by_a_recorder(bus: ZenohBus) -> None:
    heard = asyncio.Event()
    watch = bus.watch_alive(recorder_key(ROBOT, "*"), lambda _, alive: heard.set() if alive else None)
    await asyncio.wait_for(heard.wait(), PATIENCE_S)
    watch.close()


@pytest.mark.process
def test_a_killed_recorder_leaves_all_but_the_last_moment(short_path: Path) -> None:
    draw = random.Random(5)

    async def scenario() -> None:
        async with robot(short_path) as (bus, pulse):
            for kill in range(KILLS):
                out = short_path / str(kill)
                recorder = await cocoro(short_path, "record", "--out", str(out))
                await heard_by_a_recorder(bus)
                pulse.stall_s = 0.0
                await asyncio.sleep(0.3 + 0.5 * draw.random())
                recorder.kill()
                killed_ns = time.time_ns()
                await recorder.wait()
                (path,) = out.glob("*.mcap")
                with Capture.open(path) as capture:
                    assert not capture.closed
                    states = list(capture.messages("base/state"))
                    whole = rewrite(capture, out / "whole.mcap", Packer("zstd"))
                sequences = [each.sequence for each in states]
                assert sequences == list(range(sequences[0], sequences[-1] + 1))
                # Delays by the machine's other work are not the recorder's.
                assert (killed_ns - states[-1].log_ns) / 1e9 < MISSING_S + 2 * pulse.stall_s
                assert [each.sequence for each in all_of(whole.path, "base/state")] == sequences

    asyncio.run(scenario())


@pytest.mark.process
def test_a_recording_ends_well_when_it_is_told_to(short_path: Path) -> None:
    async def scenario() -> None:
        async with robot(short_path) as (bus, _):
            recorder = await cocoro(short_path, "record", "--out", str(short_path / "out"))
            await heard_by_a_recorder(bus)
            await asyncio.sleep(0.2)
            recorder.terminate()
            out, err = await asyncio.wait_for(recorder.communicate(), PATIENCE_S)
            assert (recorder.returncode, err) == (0, b"")
            (path,) = (short_path / "out").glob("*.mcap")
            assert str(path) in out.decode()
            with Capture.open(path) as capture:
                assert capture.whole
                assert "calliope/base/state" in capture.keys
                assert capture.metadata["service/base"]["service"] == "base"

    asyncio.run(scenario())


@pytest.mark.process
@pytest.mark.parametrize("became", ["moved", "removed"])
def test_a_recording_whose_file_is_taken_away_goes_on_in_the_next_one_and_says_what_is_on_the_disk(
    became: str, short_path: Path
) -> None:
    out, kept = short_path / "out", short_path / "kept.mcap"

    async def scenario() -> None:
        async with robot(short_path) as (bus, _):
            recorder = await cocoro(short_path, "record", "--out", str(out))
            await heard_by_a_recorder(bus)
            (first,) = await files_of(out, 1)
            if became == "moved":
                first.rename(kept)
            else:
                first.unlink()
            (second,) = await files_of(out, 1)
            assert second.name.endswith("-002.mcap")
            recorder.terminate()
            said, err = await asyncio.wait_for(recorder.communicate(), PATIENCE_S)
            paths = [second, kept] if became == "moved" else [second]
            count = sum(len(all_of(path)) for path in paths)
            last = said.decode().splitlines()[-1]
            assert f": {count} messages" in last
            assert last.startswith(str(second))
            if became == "moved":
                assert f"{first} was moved to {kept} while it was recorded" in err.decode()
            else:
                assert f"{first} was removed (or moved to another disk) while it was recorded" in err.decode()
            assert recorder.returncode == (0 if became == "moved" else 1)

    asyncio.run(scenario())


async def files_of(folder: Path, count: int) -> list[Path]:
    """Wait until a folder has so many captures."""
    return await asyncio.to_thread(_files_of, folder, count)


def _files_of(folder: Path, count: int) -> list[Path]:
    until_s = time.monotonic() + PATIENCE_S
    while len(found := sorted(folder.glob("*.mcap"))) < count:
        assert time.monotonic() < until_s, f"{folder} has {len(found)} captures, not {count}"
        time.sleep(0.05)
    return found


class Wall:
    """A wall clock that the test sets."""

    def __init__(self) -> None:
        self.ahead_ns = 0

    def __call__(self) -> int:
        return time.time_ns() + self.ahead_ns


@pytest.mark.parametrize("by_s", [-3600, 3600])
def test_a_recorder_whose_wall_clock_is_set_goes_on_as_if_it_had_not_been_and_notes_it(
    by_s: int, short_path: Path
) -> None:
    out, wall = short_path / "out", Wall()
    config = CaptureConfig(folder=str(out), rotate_s=0.5, per_occasion=False)

    async def scenario() -> None:
        async with (
            robot(short_path) as (bus, _),
            await ZenohBus.open(default(ROBOT, "recorder", short_path)) as other,
            Node("capture", other, RealClock(), Robot.load(), config=config) as node,
        ):
            recording = asyncio.ensure_future(run(node, config, LogClock(wall)))
            await heard_by_a_recorder(bus)
            count = len(await files_of(out, 2))
            wall.ahead_ns += by_s * NS
            await files_of(out, count + 4)
            recording.cancel()
            await asyncio.gather(recording, return_exceptions=True)

    began_ns = time.time_ns()
    asyncio.run(scenario())
    took_ns = time.time_ns() - began_ns
    files = sorted(out.glob("*.mcap"))
    states = [record for path in files for record in all_of(path, "base/state")]
    assert [each.log_ns for each in states] == sorted(each.log_ns for each in states)
    late_ns = [each.log_ns - each.publish_ns for each in states]
    assert -NS // 100 < min(late_ns) <= max(late_ns) < took_ns, "received after it was sent, and before the end"
    assert states[-1].log_ns - states[0].log_ns > (len(files) - 2) * NS // 2
    with Capture.open(files[-1]) as capture:
        found = report(capture)
    (step,) = found.metadata[WALL_CLOCK]["steps"]
    assert step["by_s"] == pytest.approx(by_s, abs=0.01)
    assert f"clock     set {'forward' if by_s > 0 else 'back'} by {abs(step['by_s']):.3f} s" in capture_command.text(
        found
    )


@pytest.mark.process
def test_a_capture_that_is_made_by_hand_has_the_profile_of_the_start(short_path: Path) -> None:
    profile = {"name": "sim", "robot": ROBOT, "clock": "real", "processes": ["base"]}

    async def scenario() -> None:
        async with robot(short_path) as (bus, _):
            RunDir(ROBOT, short_path).remember(json.dumps(profile).encode())
            recorder = await cocoro(short_path, "record", "--out", str(short_path / "out"))
            await heard_by_a_recorder(bus)
            recorder.terminate()
            await asyncio.wait_for(recorder.communicate(), PATIENCE_S)
            (path,) = (short_path / "out").glob("*.mcap")
            with Capture.open(path) as capture:
                assert json.loads(capture.metadata["profile"]["profile"]) == profile

    asyncio.run(scenario())


@pytest.mark.process
def test_a_recorder_without_a_place_to_write_says_so_and_exits_with_1(short_path: Path) -> None:
    (short_path / "file").write_text("no folder")

    async def scenario() -> None:
        async with robot(short_path):
            recorder = await cocoro(short_path, "record", "--out", str(short_path / "file" / "captures"))
            _, err = await asyncio.wait_for(recorder.communicate(), PATIENCE_S)
            assert recorder.returncode == 1
            assert "recording has stopped" in err.decode()
            assert "Traceback" not in err.decode()

    asyncio.run(scenario())


@pytest.mark.process
def test_replay_refuses_a_mesh_with_a_robot_and_plays_where_there_is_none(short_path: Path) -> None:
    path = record(short_path / "drive.mcap", drive)

    async def refused() -> None:
        async with robot(short_path):
            replay = await cocoro(short_path, "replay", str(path), "--hardware")
            _, err = await asyncio.wait_for(replay.communicate(), PATIENCE_S)
            assert replay.returncode == 3
            assert "a robot named calliope is alive (base)" in err.decode()

    async def played() -> None:
        async with await ZenohBus.open(default(ROBOT, "test", short_path)) as bus:
            found: list[bytes] = []
            bus.subscribe("calliope/base/state", Qos.EVENT, lambda _, payload: found.append(bytes(payload)), depth=0)
            replay = await cocoro(short_path, "replay", str(path), "--rate", "4")
            out, err = await asyncio.wait_for(replay.communicate(), PATIENCE_S)
            assert (replay.returncode, err) == (0, b"")
            assert "2.0 of 2.0 s" in out.decode()
            assert found == [bytes(each.payload) for each in all_of(path, "base/state")]

    asyncio.run(refused())
    asyncio.run(played())


@pytest.mark.process
def test_replay_is_worked_by_the_keyboard(short_path: Path) -> None:
    path = record(short_path / "drive.mcap", drive)
    ours, theirs = os.openpty()
    replay = subprocess.Popen(
        [sys.executable, "-m", "apps.cli.main", "replay", str(path), "--paused"],
        env=os.environ | {"COCORO_RUN_DIR": str(short_path)}, stdin=theirs, stdout=theirs, stderr=theirs,
    )  # fmt: skip
    os.close(theirs)
    screen = Screen(ours)
    screen.wait_for("paused 0.0 of 2.0 s")
    os.write(ours, b".")
    screen.wait_for("2 messages")
    os.write(ours, b"\x1b[C")
    screen.wait_for("paused 2.0 of 2.0 s")
    os.write(ours, b"\x1b[D")
    screen.wait_for("paused 0.0 of 2.0 s")
    screen.wait_for("pass 2")
    os.write(ours, b"-")
    screen.wait_for("x0.80")
    os.write(ours, b"++x-\x1bOC\x1b[D")  # in one write, as from keys that are held down
    screen.wait_for("paused 0.0 of 2.0 s, x1.00")
    os.write(ours, b" ")
    screen.wait_for("0.3 of 2.0 s")
    os.write(ours, b"q")
    assert replay.wait(PATIENCE_S) == 0
    os.close(ours)


class Screen:
    """The output of a program on its terminal."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._text = ""

    def wait_for(self, words: str) -> None:
        """Wait for an output; earlier output is forgotten."""
        until_s = time.monotonic() + PATIENCE_S
        while words not in self._text:
            assert time.monotonic() < until_s, f"{words!r} does not come; there is {self._text[-300:]!r}"
            if select.select([self._fd], [], [], 0.1)[0]:
                self._text += os.read(self._fd, 4096).decode(errors="replace")
        self._text = self._text.partition(words)[2]
