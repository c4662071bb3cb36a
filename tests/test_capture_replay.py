"""Replay: the time line alone, on the mesh, and recorded again."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from capture_rig import ROBOT, Room, all_of, drive, entry, record, writer

from apps.captures.replay import Replay, heard_as, played_keys, refuse_if_alive, restarted, services_of, with_rate
from apps.cli.main import main
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.capture.player import AT_ONCE, FASTEST, Player
from cocoro.capture.reader import Capture
from cocoro.clock import FollowedClock
from cocoro.core import Output, Sample, Schedule, Take
from cocoro.errors import ConfigError, RefusedError
from cocoro.messages import BaseState, ClockTick, Detections, Frame, PlannerStatus, StepRecord
from cocoro.node import Node
from cocoro.vloop import run_virtual


@pytest.fixture
def capture(tmp_path: Path) -> Iterator[Capture]:
    """Ten states, 0.1 s apart, and a picture with every second one."""
    written = writer(tmp_path)
    for n in range(10):
        at_ns = 10**9 + n * 10**8
        written.put(entry("base/state", n, log_ns=at_ns))
        if n % 2 == 0:
            written.put(entry("kinect/frame", n, log_ns=at_ns))
    written.close()
    with Capture.open(written.file.path) as opened:
        yield opened


def every(_: str) -> bool:
    return True


def states(key: str) -> bool:
    return key.endswith("base/state")


def played(player: Player, *times_s: float) -> list[list[int]]:
    return [[each.sequence for each in player.due(time_s)] for time_s in times_s]


# --- the time line --------------------------------------------------------------------------------


def test_messages_are_due_by_the_spacing_that_they_were_recorded_with(capture: Capture) -> None:
    player = Player(capture, states)
    assert played(player, 100.0, 100.05, 100.1, 100.35, 100.9) == [[0], [], [1], [2, 3], [4, 5, 6, 7, 8, 9]]
    assert player.ended
    assert player.length_s == pytest.approx(0.9)


def test_the_rate_stretches_time_and_may_change_on_the_way(capture: Capture) -> None:
    player = Player(capture, states, rate=2.0)
    assert played(player, 0.0, 0.1) == [[0], [1, 2]]
    player.change_rate(0.1, 0.5)
    assert played(player, 0.25, 0.31, 0.5) == [[], [3], [4]]
    assert player.wait_s(0.5) == pytest.approx(0.2)
    player.change_rate(0.5, 1e9)
    assert player.rate == FASTEST


def test_a_span_is_played_and_nothing_else(capture: Capture) -> None:
    player = Player(capture, states, start_s=0.25, end_s=0.7)
    assert played(player, 5.0, 5.04, 5.06, 9.0) == [[], [], [3], [4, 5, 6]]
    assert player.ended


def test_a_pause_stops_time_and_a_step_goes_to_the_next_picture(capture: Capture) -> None:
    player = Player(capture, every)
    assert played(player, 0.0, 0.1) == [[0, 0], [1]]
    player.toggle(0.15)
    assert player.wait_s(0.15) is None
    assert played(player, 3.0) == [[]]
    player.step(3.0)
    assert player.wait_s(3.0) == 0.0
    assert played(player, 3.0, 4.0) == [[2, 2], []]
    assert player.position_s(4.0) == pytest.approx(0.2)
    player.toggle(5.0)
    assert played(player, 5.05, 5.11) == [[], [3]]


def test_seeking_jumps_and_going_back_begins_a_new_pass(capture: Capture) -> None:
    player = Player(capture, states)
    assert played(player, 0.0) == [[0]]
    player.seek(0.0, 0.75)
    assert (player.passes, played(player, 0.0, 0.06)) == (0, [[], [8]])
    player.seek(0.06, -5.0)
    assert (player.passes, played(player, 0.06, 0.17)) == (1, [[0], [1]])
    player.seek(0.2, 99.0)
    assert played(player, 0.2) == [[9]]
    assert player.ended


def test_a_loop_begins_again_when_the_last_has_had_its_time(capture: Capture) -> None:
    player = Player(capture, states, loop=True, start_s=0.6)
    assert played(player, 0.0, 0.4, 0.4, 0.5) == [[6], [7, 8, 9], [6], [7]]
    assert player.passes == 1
    assert not player.ended


def test_one_message_for_ever_leaves_others_their_turn(tmp_path: Path) -> None:
    written = writer(tmp_path)
    written.put(entry("base/state", 0))
    written.close()
    with Capture.open(written.file.path) as capture:
        player = Player(capture, every, loop=True)
        assert played(player, 0.0) == [[0]]
        wait_s = player.wait_s(0.0)
        assert wait_s is not None
        assert wait_s > 0.0


def test_much_that_is_due_comes_in_parts(tmp_path: Path) -> None:
    written = writer(tmp_path)
    for n in range(2 * AT_ONCE):
        written.put(entry("base/state", n))
    written.close()
    with Capture.open(written.file.path) as capture:
        player = Player(capture, every, rate=FASTEST)
        player.due(0.0)
        assert len(player.due(1e6)) == AT_ONCE
        assert player.wait_s(1e6) == 0.0


# --- in a time line that has gone back ------------------------------------------------------------


def test_the_first_pass_leaves_payloads_as_they_are_and_the_next_has_other_incarnations() -> None:
    seen = Detections(seq=3, incarnation=70, frame_seq=5, frame_incarnation=90, width=1, height=1)
    payload = msgspec.msgpack.encode(seen)
    assert restarted(payload, 0) is payload
    again = [msgspec.msgpack.decode(restarted(payload, passes), type=Detections) for passes in (1, 2)]
    assert len({seen.incarnation, *(each.incarnation for each in again)}) == 3
    assert again[0].frame_incarnation - 90 == again[0].incarnation - 70
    assert (again[0].seq, again[0].frame_seq) == (3, 5)
    step = StepRecord(incarnation=1, now_ns=7, consumed=(("base/state", 70, 1),), produced=(("x/y", 90, 2),))
    later = msgspec.msgpack.decode(restarted(msgspec.msgpack.encode(step), 1), type=StepRecord)
    assert later.consumed == (("base/state", again[0].incarnation, 1),)
    assert later.produced == (("x/y", again[0].frame_incarnation, 2),)
    for strange in (b"", b"\xc1", msgspec.msgpack.encode([1, 2])):
        assert restarted(strange, 1) == strange


def test_the_clock_says_how_fast_time_goes() -> None:
    payload = msgspec.msgpack.encode(ClockTick(rate=0.9, stamp_ns=5))
    assert with_rate(payload, 1.0) is payload
    assert msgspec.msgpack.decode(with_rate(payload, 2.0), type=ClockTick) == ClockTick(rate=1.8, stamp_ns=5)
    assert with_rate(b"\xc1", 2.0) == b"\xc1"


# --- on the mesh ----------------------------------------------------------------------------------


async def think(room: Room) -> None:
    """A robot that drives, and a service that answers each state: hardware's keys and others."""
    async with room.node("planning") as planning:

        def answer(_: BaseState) -> None:
            planning.publish(topics.PLAN, PlannerStatus())

        planning.ready()
        planning.on(topics.BASE_STATE, answer)
        await drive(room, 2.0)


def replayed(path: Path, out: Path, *, hardware: bool = False, **options: Any) -> Path:
    """The capture of a capture's replay."""

    async def play(room: Room) -> None:
        with Capture.open(path) as capture:
            keys = played_keys(capture, (), hardware)
            bus = room.mesh.join()
            await refuse_if_alive(bus, capture.robot, services_of(keys))
            await Replay(bus, capture, Player(capture, keys.__contains__, **options), hardware=hardware).run()

    return record(out, play)


def test_a_capture_of_a_replay_has_the_same_payloads_in_the_same_order(tmp_path: Path) -> None:
    first = record(tmp_path / "first.mcap", think)
    second = replayed(first, tmp_path / "second.mcap")
    payloads = [_payloads(path) for path in (first, second)]
    assert {"calliope/base/state", "calliope/kinect/frame", "calliope/planning/status"} <= set(payloads[0])
    assert payloads[0] == payloads[1]
    spacing = [[each.log_ns for each in all_of(path, "base/state")] for path in (first, second)]
    shift = spacing[1][0] - spacing[0][0]
    assert [at_ns - shift for at_ns in spacing[1]] == pytest.approx(spacing[0], abs=1000)


def _payloads(path: Path) -> dict[str, list[bytes]]:
    """Payloads by key, without what recorders publish about themselves."""
    found: dict[str, list[bytes]] = defaultdict(list)
    for each in all_of(path):
        service, _, topic = each.key.removeprefix("calliope/").partition("/")
        if service != "capture" and topic not in ("alive", "requests", "recorder"):
            found[each.key].append(bytes(each.payload))
    return dict(found)


def test_hardware_alone_impersonates_the_robot_with_a_clock(tmp_path: Path) -> None:
    path = record(tmp_path / "first.mcap", think)
    followed: list[tuple[int, int]] = []
    alive: set[str] = set()

    async def listen(room: Room) -> None:
        clock = FollowedClock()
        async with Node("planning", room.mesh.join(), clock, ROBOT) as node:
            node.watch_alive(lambda service, there: alive.add(service) if there else None)
            node.on(topics.BASE_STATE, lambda state: followed.append((state.stamp_ns, clock.now_ns())))
            with Capture.open(path) as capture:
                keys = played_keys(capture, (), hardware=True)
                assert services_of(keys) == {"base", "kinect"}
                player = Player(capture, keys.__contains__, loop=True)
                playing = asyncio.ensure_future(Replay(room.mesh.join(), capture, player, hardware=True).run())
                await asyncio.sleep(3.0)
                playing.cancel()
                await asyncio.gather(playing, return_exceptions=True)
        assert clock.epoch == player.passes == 1

    run_virtual(listen(Room()))
    assert alive == {"kinect", "base", "arm", "hand"}
    assert len(followed) > 120
    assert all(abs(now_ns - stamp_ns) < 10**8 for stamp_ns, now_ns in followed[2:])


def test_a_capture_is_heard_by_a_robot_of_another_name(tmp_path: Path) -> None:
    path = record(tmp_path / "first.mcap", think)
    heard: list[str] = []

    async def listen(room: Room) -> None:
        bus = room.mesh.join()
        bus.subscribe("**", Qos.EVENT, lambda key, _: heard.append(key), depth=0)
        bus.watch_alive("*/*/alive", lambda key, alive: heard.append(key))
        with Capture.open(path) as capture:
            player = Player(capture, played_keys(capture, (), hardware=True).__contains__)
            await Replay(room.mesh.join(), capture, player, hardware=True, robot="other").run()

    run_virtual(listen(Room()))
    assert heard.count("other/base/state") == 100
    assert {"other/sim/clock", "other/kinect/frame", "other/base/alive"} <= set(heard)
    assert {key.partition("/")[0] for key in heard} == {"other"}


def test_the_robot_that_waits_for_hardware_is_found_or_must_be_named() -> None:
    waiting, whole = {"perception", "planning"}, {"planning", "base", "kinect"}
    assert heard_as("r1", {}) == "r1"
    assert heard_as("r1", {"calliope": waiting}) == "calliope"
    assert heard_as("r1", {"calliope": waiting, "r1": waiting}) == "r1"
    assert heard_as("r1", {"calliope": waiting, "busy": whole, "simulated": {"sim"}}) == "calliope"
    assert heard_as("r1", {"busy": whole}) == "r1"
    with pytest.raises(ConfigError, match="--robot one or --robot two"):
        heard_as("r1", {"one": waiting, "two": waiting})


class Counting:
    """A core that counts its input states."""

    reads: Mapping[Any, Take] = {topics.BASE_STATE: "all"}
    schedule = Schedule(None, (topics.BASE_STATE,))

    def __init__(self) -> None:
        self.heard = 0

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        self.heard += len(inputs)
        return ()


def test_what_thinks_is_up_before_the_capture_begins_and_misses_nothing_of_it(tmp_path: Path) -> None:
    """`cocoro up replay` in one terminal, then `cocoro replay --hardware` in another; until then there is no clock."""
    path = record(tmp_path / "first.mcap", drive)
    core = Counting()

    async def think_along(room: Room) -> None:
        async with Node("planning", room.mesh.join(), FollowedClock(), ROBOT) as node:
            thinking = asyncio.ensure_future(node.drive(core))
            await asyncio.sleep(1.0)
            assert node.state == "ready"
            with Capture.open(path) as capture:
                player = Player(capture, played_keys(capture, (), hardware=True).__contains__)
                await Replay(room.mesh.join(), capture, player, hardware=True).run()
            thinking.cancel()
            await asyncio.gather(thinking, return_exceptions=True)

    run_virtual(think_along(Room()))
    assert core.heard == len(all_of(path, "base/state")) == 100


def test_a_mesh_with_a_robot_of_that_name_is_left_alone(tmp_path: Path) -> None:
    path = record(tmp_path / "first.mcap", think)

    async def try_it(room: Room, service: str, hardware: bool) -> None:
        async with room.node(service) as node:
            node.ready()
            with Capture.open(path) as capture:
                await refuse_if_alive(room.mesh.join(), "calliope", services_of(played_keys(capture, (), hardware)))

    for service, hardware in (("base", True), ("arm", False), ("sim", True), ("planning", False)):
        with pytest.raises(RefusedError, match=service):
            run_virtual(try_it(Room(), service, hardware))
    run_virtual(try_it(Room(), "planning", hardware=True))
    run_virtual(try_it(Room(), "capture", hardware=False))


def test_what_there_is_not_cannot_be_played(tmp_path: Path) -> None:
    path = record(tmp_path / "first.mcap", drive)
    with Capture.open(path) as capture:
        assert played_keys(capture, ["base/*"], hardware=False) == {
            "calliope/base/state", "calliope/base/health", "calliope/base/requests",
        }  # fmt: skip
        with pytest.raises(ConfigError, match="nothing to play"):
            played_keys(capture, ["arm/**"], hardware=True)


def test_a_reader_takes_every_pass_of_a_loop(tmp_path: Path) -> None:
    path = record(tmp_path / "first.mcap", drive)
    got: list[BaseState] = []

    async def listen(room: Room) -> None:
        async with room.node("planning") as node:
            node.on(topics.BASE_STATE, got.append)
            with Capture.open(path) as capture:
                player = Player(capture, states, loop=True)
                playing = asyncio.ensure_future(Replay(room.mesh.join(), capture, player).run())
                await asyncio.sleep(6.5)
                playing.cancel()
                await asyncio.gather(playing, return_exceptions=True)
            assert node.inbox(topics.BASE_STATE).rejected == 0

    run_virtual(listen(Room()))
    assert len(got) >= 300
    assert len({state.incarnation for state in got}) >= 3


def test_lossy_frames_are_played_as_frames(tmp_path: Path) -> None:
    path = record(tmp_path / "lossy.mcap", drive, jpeg_quality=90)
    got: list[Frame] = []

    async def listen(room: Room) -> None:
        async with room.node("perception") as node:
            node.on(topics.FRAME, got.append)
            with Capture.open(path) as capture:
                keys = played_keys(capture, ["frames"], hardware=False)
                await Replay(room.mesh.join(), capture, Player(capture, keys.__contains__)).run()
            await asyncio.sleep(0.1)

    run_virtual(listen(Room()))
    assert [frame.seq for frame in got] == list(range(20))


def test_a_replay_is_refused_a_name_that_is_no_robots(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(tmp_path / "first.mcap", drive)
    assert main(["replay", str(path), "--robot", "../other"]) == 2
    assert "--robot ../other: a name has" in capsys.readouterr().err
