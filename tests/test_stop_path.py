"""The emergency stop's path: who receives it, whose answers count, and what cannot prevent it."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from stop_rig import PATIENCE_S, full_queue, new_robot, stop

from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.stop import asking as asking_module
from cocoro.stop.asking import Asking, addresses
from cocoro.stop.path import PREFIX, StopPoint, listen
from services.cockpit.stopping import Stopper

ROOT = Path(__file__).parents[1]
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can be another user")


@pytest.fixture
def robot() -> str:
    return new_robot()


def kept(_by: str, why_not: str = "") -> Future[str]:
    """The disk's answer to a latch that is to be kept, given at once."""
    done: Future[str] = Future()
    done.set_result(why_not)
    return done


@contextmanager
def moving(robot: str, *services: str, keep: Callable[[str], Future[str]] = kept) -> Iterator[dict[str, list[str]]]:
    """Services that can be stopped; yields, for each, by whom it has been stopped."""
    halted: dict[str, list[str]] = {service: [] for service in services}
    with ExitStack() as stack:
        for service in services:
            point = StopPoint(robot, service)
            stack.callback(point.close)
            listen(point, halted[service].append, keep)
        yield halted


def reached(asking: Asking) -> list[bool]:
    """Flags of the robot's stop points to which the request has been delivered."""
    return [point.sent_s is not None for point in asking.points.values()]


def another_user(robot: str, code: str) -> subprocess.Popen[str]:
    """Run Python code as nobody (user 65534) with an empty environment and `robot` as its argument."""
    imports = f"import os, socket, sys, time; sys.path.insert(0, {str(ROOT)!r}); from cocoro.stop.asking import Asking;"
    become = "os.setgroups([]); os.setgid(65534); os.setuid(65534);"
    command = [sys.executable, "-I", "-S", "-c", imports + become + code, robot]
    return subprocess.Popen(command, env={}, cwd="/", stdout=subprocess.PIPE, text=True)


@contextmanager
def a_liar(robot: str) -> Iterator[None]:
    """A process of another user that answers as the base, at an address that names this user."""
    code = (
        "s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM);"
        f"s.bind(b'\\0{PREFIX}0/' + sys.argv[1].encode() + b'/base/liar');"
        "print('there', flush=True); _, who = s.recvfrom(100); s.sendto(b'latched base 1', who); s.recvfrom(100)"
    )
    with another_user(robot, code) as liar:
        try:
            assert liar.stdout is not None
            assert liar.stdout.readline() == "there\n"
            yield
        finally:
            liar.kill()


def test_everything_that_moves_is_halted_before_it_answers_and_says_that_the_latch_is_kept(robot: str) -> None:
    with moving(robot, "base", "arm", "hand") as halted:
        before_ns = time.monotonic_ns()
        asking = stop(robot)
        after_ns = time.monotonic_ns()
        assert {point.service for point in asking.points.values()} == {"base", "arm", "hand"}
        for point in asking.points.values():
            assert before_ns <= (point.latched_ns or 0) <= after_ns
            assert (point.kept, point.why_not_kept) == (True, "")
            assert halted[point.service] == [f"operator (user {os.getuid()}, pid {os.getpid()})"]
        assert not asking.waiting


def test_who_asks_is_told_of_each_that_is_halted_as_it_answers(robot: str) -> None:
    told: list[tuple[str, bool]] = []
    with moving(robot, "base", "arm", "hand"):
        with Asking(robot, heard=lambda point: told.append((point.service, point.latched_ns is not None))) as asking:
            asking.go_on(time.monotonic() + PATIENCE_S)
        assert sorted(told) == [("arm", True), ("base", True), ("hand", True)]


def test_the_cockpits_stop_takes_the_path_and_needs_no_answer_of_the_mesh(robot: str) -> None:
    news: list[dict[str, Any]] = []

    async def stopped() -> dict[str, Any]:
        bus = LocalMesh().join()  # on which nobody answers
        async with Node("cockpit", bus, RealClock(), Robot.load(), robot_name=robot) as node:
            stopper = Stopper(node, news.append)
            for service in ("base", "arm", "hand"):
                stopper.lives(service, True)
            return await stopper.stop("ada")

    with moving(robot, "base", "arm", "hand") as halted:
        told = asyncio.run(stopped())
        assert told["acknowledged"] == ["base", "arm", "hand"]
        assert (told["missing"], told["trouble"], told["final"]) == ([], "", True)
        assert [one["final"] for one in news] == [False, True]  # the first acknowledgement is told at once
        assert all(by[0].startswith("cockpit: ada") for by in halted.values())


def test_a_robot_is_stopped_by_its_name_and_another_is_not(robot: str) -> None:
    with moving(robot, "base") as ours, moving(f"{robot}-2", "base") as other:
        assert len(stop(robot).points) == 1
        assert (len(ours["base"]), len(other["base"])) == (1, 0)


def test_without_a_name_every_robot_is_told() -> None:
    names = [f"all-{os.urandom(4).hex()}" for _ in range(2)]
    with moving(names[0], "base"), moving(names[1], "arm"):
        found = {address.split("/")[2] for address in addresses()}
        assert found >= set(names)


def test_who_has_ended_is_not_waited_for(robot: str) -> None:
    with moving(robot, "base"):
        pass
    assert all(point.gone for point in stop(robot).points.values())


def test_a_latch_that_the_disk_did_not_take_is_told(robot: str) -> None:
    with moving(robot, "base", keep=partial(kept, why_not="the disk is full")) as halted:
        (point,) = stop(robot).points.values()
        assert (point.kept, point.why_not_kept) == (False, "the disk is full")
        assert halted["base"]


@pytest.mark.parametrize("datagram", [b"", b"hello", b"\xff" * 100, bytes(5000)])
def test_every_datagram_is_a_stop_whatever_it_says(robot: str, datagram: bytes) -> None:
    with moving(robot, "base") as halted:
        (address,) = addresses(robot)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:  # without an address to answer to
            sender.sendto(datagram, b"\0" + address[1:].encode())
        assert stop(robot).waiting == []
        assert len(halted["base"]) == 2


def test_what_a_sender_calls_himself_cannot_spoil_a_line_and_who_he_is_says_the_kernel(robot: str) -> None:
    with moving(robot, "base") as halted:
        with Asking(robot, by="the king\n\x1b[2J") as asking:
            asking.go_on(time.monotonic() + PATIENCE_S)
        assert halted["base"] == [f"the king[2J (user {os.getuid()}, pid {os.getpid()})"]


def test_a_flood_of_datagrams_stops_the_robot_and_keeps_nobody_else_from_stopping_it(robot: str) -> None:
    begun, ended = threading.Event(), threading.Event()

    def flood(address: bytes) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            while not ended.is_set():
                sender.sendto(b"rubbish", address)
                begun.set()

    with moving(robot, "base") as halted:
        (address,) = addresses(robot)
        flooding = threading.Thread(target=flood, args=(b"\0" + address[1:].encode(),))
        flooding.start()
        try:
            assert begun.wait(10.0)  # datagrams of the flood lie in the queue before the one of the stop
            asking = stop(robot)
            assert not asking.waiting
            assert len(halted["base"]) > 1
        finally:
            ended.set()
            flooding.join()


def test_who_does_not_read_is_named_and_holds_up_nobody(robot: str) -> None:
    deaf = StopPoint(robot, "arm")
    try:
        with moving(robot, "base") as halted:
            asking = stop(robot, within_s=0.1)
            assert [point.service for point in asking.waiting] == ["arm"]
            assert halted["base"]
            # The request waits in its queue, so it stops as soon as it continues.
            taken = deaf.take(wait=False)
            assert taken is not None
            assert taken.by.startswith("operator")
    finally:
        deaf.close()


def test_full_queues_are_tried_again(robot: str) -> None:
    slow = StopPoint(robot, "base")
    (address,) = addresses(robot)
    with full_queue(address), Asking(robot) as asking:
        assert reached(asking) == [False]
        halted: list[str] = []
        listen(slow, halted.append, kept)
        asking.go_on(time.monotonic() + PATIENCE_S)
        assert reached(asking) == [True]
        assert all(point.latched_ns for point in asking.points.values())
        assert halted[-1].startswith("operator")
    slow.close()


def test_who_finds_no_room_in_a_flood_is_there_as_soon_as_there_is_some(
    robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asking_module, "LOOK_AGAIN_S", PATIENCE_S)  # it is not tried by and by
    full = StopPoint(robot, "base")
    (address,) = addresses(robot)
    with full_queue(address), Asking(robot) as asking:
        asking.go_on(time.monotonic() + 0.05)
        assert reached(asking) == [False]
        while full.take(wait=False) is not None:
            pass
        asking.go_on(time.monotonic() + 0.05)
        assert reached(asking) == [True]
    full.close()


def test_one_who_appears_while_others_are_waited_for_is_told_too(robot: str) -> None:
    deaf = StopPoint(robot, "arm")
    with Asking(robot) as asking:
        assert len(asking.points) == 1
        with moving(robot, "base") as halted:
            asking.go_on(time.monotonic() + 5 * asking_module.LOOK_AGAIN_S)
            while not halted["base"]:
                asking.go_on(time.monotonic() + asking_module.LOOK_AGAIN_S)
        assert {point.service for point in asking.points.values()} == {"arm", "base"}
    deaf.close()


def test_rubbish_in_the_list_of_sockets_is_passed_over(robot: str) -> None:
    with ExitStack() as stack, moving(robot, "base"):
        for number, name in enumerate((f"{PREFIX}x/{robot}/base/1", f"{PREFIX}0/{robot}", f"{PREFIX}0/{robot}/a/b/c")):
            squatter = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            squatter.bind(b"\0" + name.encode() + b"\xff" * number)
        asking = stop(robot)
        assert [point.service for point in asking.points.values()] == ["base"]
        assert not asking.waiting


def test_what_fails_in_the_path_is_a_stop_that_nobody_is_told_was_heard_and_the_path_goes_on(
    robot: str, caplog: pytest.LogCaptureFixture
) -> None:
    halted: list[str] = []
    out_of_order = True

    def halt(by: str) -> None:
        halted.append(by)
        if out_of_order and by.startswith("operator"):
            raise RuntimeError("out of order")

    point = StopPoint(robot, "base")
    listen(point, halt, kept)
    assert [one.service for one in stop(robot, within_s=0.1).waiting] == ["base"]
    assert halted[1] == "the failure of its own path"
    assert "the emergency stop's path failed" in caplog.text
    out_of_order = False
    assert not stop(robot).waiting, "it still hears"
    point.close()


def test_a_disk_that_hangs_holds_up_no_further_stop_and_is_told_later(robot: str) -> None:
    disk: Future[str] = Future()
    with moving(robot, "base", keep=lambda _: disk) as halted, ExitStack() as stack:
        first = stack.enter_context(Asking(robot))
        first.go_on(time.monotonic() + PATIENCE_S)
        for _ in range(100):
            with Asking(robot) as another:
                another.go_on(time.monotonic() + PATIENCE_S)
                assert not another.waiting
        assert len(halted["base"]) > 100
        assert [point.kept for point in first.points.values()] == [None]
        disk.set_result("too late")
        first.hear_of_the_disk(time.monotonic() + PATIENCE_S)
        assert [(point.kept, point.why_not_kept) for point in first.points.values()] == [(False, "too late")]


def test_who_floods_the_asker_with_answers_neither_keeps_him_nor_hides_the_others(robot: str) -> None:
    ended = threading.Event()
    liar = StopPoint(robot, "arm")

    def flood() -> None:
        asked = liar.take(wait=True)
        while asked is not None and not ended.is_set():
            liar._answer(asked, "rubbish")

    flooding = threading.Thread(target=flood)
    flooding.start()
    try:
        with moving(robot, "base", "hand"):
            asking = stop(robot, within_s=0.5)
        assert [point.service for point in asking.waiting] == ["arm"]
    finally:
        ended.set()
        liar.close()
        flooding.join()


def test_nobody_else_reaches_the_line_on_which_a_point_answers(robot: str) -> None:
    deaf = StopPoint(robot, "base")
    with Asking(robot), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        asked = deaf.take(wait=False)
        assert asked is not None
        with pytest.raises(PermissionError):
            stranger.sendto(b"latched base 1", asked.answer_to)
    deaf.close()


@pytest.mark.process
@pytest.mark.parametrize("free", [1, 2, 3, 1500], ids=lambda free: f"{free}-files-left")
def test_a_caller_that_has_nearly_all_its_files_open_stops_the_robot(robot: str, free: int) -> None:
    """The case includes a next file with a number that select(2) cannot take."""
    code = (
        "import resource, time; hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1];"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (min(3000, hard), hard));"
        "from cocoro.stop.asking import Asking\nopen_files = []\n"
        "try:\n  while True: open_files.append(open('/dev/null'))\nexcept OSError: pass\n"
        "del open_files[-int(sys.argv[2]):]\n"
        "a = Asking(sys.argv[1]); a.go_on(time.monotonic() + 60)\n"
        "print(sorted(p.service for p in a.points.values() if p.latched_ns))"
    )
    with moving(robot, "arm", "base", "hand") as halted:
        command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}); " + code, robot, str(free)]
        said = subprocess.run(command, capture_output=True, text=True, check=False)
        assert said.stdout == "['arm', 'base', 'hand']\n", said.stderr
        assert halted["base"]


def test_names_that_make_no_address_are_refused() -> None:
    with pytest.raises(OSError, match="too long"):
        StopPoint("r" * 100, "base")


@pytest.mark.process
@needs_root
def test_another_user_without_any_variable_can_stop_the_robot(robot: str) -> None:
    code = (
        "a = Asking(sys.argv[1]); a.go_on(time.monotonic() + 60);"
        "print([p.service for p in a.points.values() if p.latched_ns])"
    )
    with moving(robot, "base") as halted, another_user(robot, code) as stranger:
        assert stranger.communicate()[0] == "['base']\n"
        assert halted["base"] == [f"operator (user 65534, pid {stranger.pid})"]


@pytest.mark.process
@needs_root
def test_an_address_that_names_another_user_is_that_of_who_made_it(robot: str) -> None:
    """Answers of such an address, or their absence, are attributed to that user's robot."""
    with a_liar(robot), moving(robot, "arm"):
        asking = stop(robot, within_s=1.0)  # the liar never says whether its latch is on the disk
    assert {point.service: point.uid for point in asking.points.values()} == {"base": 65534, "arm": 0}


@pytest.mark.process
@needs_root
def test_where_the_kernel_does_not_tell_whose_an_address_is_only_the_answers_of_the_named_user_count(
    robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asking_module, "owners", lambda _: {})
    with a_liar(robot), moving(robot, "arm"):
        asking = stop(robot, within_s=0.3)
    assert [point.service for point in asking.waiting] == ["base"]
