"""The reader of packed frames on networks of many speeds, in virtual time: how many frames come, how old, how large."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import numpy as np
import pytest

from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.errors import CallTimeoutError
from cocoro.messages import Frame, PackedFrame, PackedRequest
from cocoro.node import Node
from cocoro.pace import LATE_S, PATIENCE, Pace
from cocoro.robot import Robot
from cocoro.topics import FRAME, PACKED, Request
from cocoro.vloop import run_virtual
from services.frames import packer, unpacker
from services.frames.pace import LEVELS, Level
from services.frames.packing import pack
from services.frames.reader import PackedReader

HZ = 30.0
DELAY_S = 0.005
BYTES = dict(zip(LEVELS, (73_000, 44_000, 33_000, 20_000, 12_000, 10_500), strict=True))


class Net:
    """A camera of 30 Hz behind a link of a rate that can change. Asks as a node does."""

    def __init__(self, rate_bps: float, delay_s: float = DELAY_S) -> None:
        self.rate_bps = rate_bps
        self.delay_s = delay_s
        self.cut = False
        picture = np.zeros((4, 4), "<u2").view(np.uint8)
        colour = memoryview(bytes(48))
        self._packed = pack(Frame(width=4, height=4, colour=colour, depth=memoryview(picture.tobytes())))

    async def call(
        self, request: Request[PackedRequest, PackedFrame], question: PackedRequest, timeout_s: float | None = None
    ) -> PackedFrame:
        now_s = asyncio.get_running_loop().time
        await asyncio.sleep(self.delay_s)
        begun_s = now_s()
        seq = int(begun_s * HZ)
        if seq == question.after_seq:
            seq += 1
            await asyncio.sleep(seq / HZ - begun_s + 1e-6)
        held_s = now_s() - begun_s
        size = next(size for level, size in BYTES.items() if level == (question.divisor, question.quality))
        took_s = self.delay_s + 8 * size / self.rate_bps
        if self.cut or took_s > request.timeout_s:
            await asyncio.sleep(request.timeout_s)
            raise CallTimeoutError("no answer")
        await asyncio.sleep(took_s)
        return PackedFrame(
            stamp_ns=int(seq / HZ * 1e9), seq=seq, incarnation=1, width=4, height=4, held_s=held_s,
            colour=self._packed.colour, depth=self._packed.depth,
        )  # fmt: skip


async def watched(net: Net, reader: PackedReader, seconds: float) -> tuple[float, float]:
    """Frames a second and the age of the oldest at its arrival, s, in the second half of the time."""
    await asyncio.sleep(seconds / 2)
    before = reader.frames
    AGES.clear()
    await asyncio.sleep(seconds / 2)
    return (reader.frames - before) / (seconds / 2), max(AGES, default=np.inf)


AGES: list[float] = []


def reading(net: Net) -> PackedReader:
    AGES.clear()
    loop = asyncio.get_running_loop()
    reader = PackedReader(net, lambda frame: AGES.append(loop.time() - frame.seq / HZ))
    net.task = asyncio.create_task(reader.run())  # type: ignore[attr-defined]
    return reader


@pytest.mark.parametrize(
    ("mbps", "best", "least_hz"), [(1000, LEVELS[0], 29), (20, LEVELS[0], 20), (5, LEVELS[3], 12), (1, LEVELS[5], 9)]
)
def test_a_network_gets_the_frames_that_it_carries_in_time(mbps: float, best: Level, least_hz: float) -> None:
    async def scenario() -> None:
        net = Net(mbps * 1e6)
        reader = reading(net)
        rate_hz, age_s = await watched(net, reader, 40.0)
        assert LEVELS.index(reader.pace.level) <= LEVELS.index(best)
        assert rate_hz >= least_hz
        assert age_s < 1 / HZ + 2 * DELAY_S + 8 * BYTES[LEVELS[-1]] / net.rate_bps + 2 * LATE_S

    run_virtual(scenario())


def test_a_network_that_becomes_slow_gets_small_frames_and_one_that_recovers_gets_good_ones() -> None:
    async def scenario() -> None:
        net = Net(1e9)
        reader = reading(net)
        await asyncio.sleep(5.0)
        assert reader.pace.level == LEVELS[0]
        net.rate_bps = 1e6
        await asyncio.sleep(5.0)
        assert reader.pace.level.divisor == 2
        net.rate_bps = 1e9
        await asyncio.sleep(20.0)
        assert reader.pace.level == LEVELS[0]

    run_virtual(scenario())


def test_a_long_way_makes_no_frame_smaller() -> None:
    async def scenario() -> None:
        reader = reading(Net(1e9, delay_s=0.1))
        await asyncio.sleep(10.0)
        assert reader.pace.level == LEVELS[0]
        assert max(AGES) < 0.1 + 0.2 + 1 / HZ

    run_virtual(scenario())


def test_a_way_that_becomes_longer_is_learned() -> None:
    async def scenario() -> None:
        net = Net(1e9)
        reader = reading(net)
        await asyncio.sleep(5.0)
        net.delay_s = 0.1
        await asyncio.sleep(20.0)
        assert reader.pace.level == LEVELS[0]

    run_virtual(scenario())


def test_after_a_cut_the_first_frame_is_a_new_one() -> None:
    async def scenario() -> None:
        net = Net(1e9)
        reader = reading(net)
        await asyncio.sleep(5.0)
        net.cut = True
        await asyncio.sleep(10.0)
        assert "not come in time" in reader.trouble
        net.cut = False
        AGES.clear()
        await asyncio.sleep(5.0)
        assert AGES
        assert max(AGES) < 0.1
        assert not reader.trouble

    run_virtual(scenario())


def test_a_level_that_was_too_much_is_tried_ever_more_rarely() -> None:
    pace = Pace(LEVELS)
    tried = []
    for number in range(4000):
        took_s = 0.09 if pace.level == LEVELS[0] else 0.01
        if pace.level == LEVELS[0]:
            tried.append(number)
        pace.arrived(took_s)
    pauses = [b - a for a, b in pairwise(tried) if b - a > PATIENCE / 2]
    assert pauses == sorted(pauses)
    assert len(tried) < 50


def test_frames_come_to_another_host_with_their_own_stamp_and_numbers() -> None:
    async def scenario() -> None:
        robot, clock = Robot.load(), VirtualClock()
        near, far = LocalMesh(), LocalMesh()
        async with (
            Node("kinect", near.join(), clock, robot) as kinect,
            Node("packer", near.join(), clock, robot) as packing,
            Node("frames-brain", far.join(), clock, robot) as unpacking,
            Node("perception", far.join(), clock, robot) as perception,
        ):
            unpacking.call = packing.call  # type: ignore[method-assign] # the gateways between the hosts
            got: list[Frame] = []
            perception.on(FRAME, got.append)
            tasks = [asyncio.create_task(packer.run(packing, packer.PackerConfig()))]
            tasks.append(asyncio.create_task(unpacker.run(unpacking, unpacker.UnpackerConfig())))
            sent = []
            for number in range(30):
                await asyncio.sleep(1 / HZ)
                depth = np.full((4, 4), number, "<u2").view(np.uint8).tobytes()
                colour = memoryview(bytes(48))
                sent.append(kinect.publish(FRAME, Frame(width=4, height=4, colour=colour, depth=memoryview(depth))))
            await asyncio.sleep(3.0)
            assert len(got) > 25
            by_seq = {frame.seq: frame for frame in sent}
            for frame in got:
                assert (frame.stamp_ns, frame.incarnation) == (by_seq[frame.seq].stamp_ns, sent[0].incarnation)
            assert [frame.seq for frame in got] == sorted({frame.seq for frame in got})
            assert unpacking.state == "degraded", "the camera is silent now"
            assert "no frame from the camera" in unpacking.text
            for task in tasks:
                task.cancel()

    run_virtual(scenario())


def test_who_asks_without_a_packer_asks_again() -> None:
    async def scenario() -> None:
        async with Node("frames-brain", LocalMesh().join(), VirtualClock(), Robot.load()) as node:
            reader = PackedReader(node, lambda _: None)
            task = asyncio.create_task(reader.run())
            await asyncio.sleep(2.0)
            assert "nobody answers" in reader.trouble
            assert PACKED.name in reader.trouble
            task.cancel()

    run_virtual(scenario())
