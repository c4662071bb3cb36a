"""The guard of the Create's port, as a process at the end of an emulated wire: the wheels stop in every case."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from wire_base import DEADMAN_NS, MS, PATIENCE_NS, SAFE, Bench, FakeService, guarded

from services.base import oi

pytestmark = [pytest.mark.zenoh, pytest.mark.alone, pytest.mark.process]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with Bench(tmp_path) as bench:
        yield bench


@pytest.fixture
def service(bench: Bench) -> Iterator[FakeService]:
    """A Create in its mode, with a guard that obeys."""
    with guarded(bench) as service:
        bench.until_awake()
        service.report(link="up")
        yield service


def test_it_wakes_the_create_stops_it_and_tells_what_it_measures(bench: Bench) -> None:
    with guarded(bench) as service:
        report = service.report(link="up")
        assert bench.create.mode == SAFE
        assert report["readings"][str(oi.VOLTAGE)] == bench.create.sensors.voltage_mv
        assert set(map(int, report["readings"])) >= {oi.BUMPS, oi.MODE, *oi.CLIFFS}


def test_full_mode_is_entered_when_that_is_asked_for(bench: Bench) -> None:
    with guarded(bench, "full") as service:
        service.report(link="up")
        assert bench.create.mode == 3


def test_wheels_turn_while_they_are_asked_to_and_stop_when_the_service_is_silent(
    bench: Bench, service: FakeService
) -> None:
    service.keep_asking(200, 100)
    bench.until_wheels(200, 100)
    service.silence()
    assert bench.until_wheels(0, 0) - service.asked_ns < DEADMAN_NS + PATIENCE_NS
    assert service.report(why="no command")["left"] == 0


def test_a_command_holds_no_longer_than_it_says(bench: Bench, service: FakeService) -> None:
    service.ask(200, 200, for_s=0.05)
    bench.until_wheels(200, 200)
    assert bench.until_wheels(0, 0) - service.asked_ns < 50 * MS + PATIENCE_NS


def test_a_command_may_not_ask_for_longer_than_the_deadman(bench: Bench, service: FakeService) -> None:
    service.ask(200, 200, for_s=1000.0)
    bench.until_wheels(200, 200)
    assert bench.until_wheels(0, 0) - service.asked_ns < DEADMAN_NS + PATIENCE_NS


def test_the_wheels_stop_at_once_when_the_service_is_gone(bench: Bench, service: FakeService) -> None:
    service.ask(200, 200)
    bench.until_wheels(200, 200)
    asked_ns = service.asked_ns
    service.close()
    assert bench.until_wheels(0, 0) - asked_ns < DEADMAN_NS
    assert service.guard.returncode == 0


@pytest.mark.parametrize("eaten", [bytes([152, 255]), bytes([140, 3, 255])], ids=["script", "song"])
def test_the_wheels_stop_though_the_create_takes_what_comes_for_the_rest_of_another_command(
    bench: Bench, service: FakeService, eaten: bytes
) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    bench.emulator.call(lambda: bench.create.receive(eaten, 57600, bench.create._now_ns))
    service.silence()
    gone_ns = time.monotonic_ns()
    service.close()
    assert bench.until_wheels(0, 0) - gone_ns < DEADMAN_NS + PATIENCE_NS
    assert service.guard.returncode == 0


def test_a_guard_that_is_told_to_end_stops_the_wheels_first(bench: Bench, service: FakeService) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    service.guard.terminate()
    bench.until_wheels(0, 0)
    assert service.guard.wait(10.0) == 0
    assert bench.create.wheels_mmps == (0, 0)


def test_ctrl_c_is_for_the_service(bench: Bench, service: FakeService) -> None:
    service.guard.send_signal(signal.SIGINT)
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    assert service.guard.poll() is None


def test_what_it_does_not_understand_it_does_not_do(bench: Bench, service: FakeService) -> None:
    for rubbish in (
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b'{"until": "soon"}',
        b'{"left": 1e999, "right": 0, "until": 1}',
    ):
        service.send(rubbish)
    service.send({"left": 100, "right": 100})
    service.send({"left": 100, "right": None, "until": 10**30})
    service.report(why="no command")
    assert bench.create.wheels_mmps == (0, 0)
    service.ask(90, 90)
    bench.until_wheels(90, 90)


def test_the_bumper_lets_nothing_forward_and_turning_and_backing_pass(bench: Bench, service: FakeService) -> None:
    bench.emulator.call(lambda: setattr(bench.create.sensors, "bump_left", True))
    service.report(link="up")
    service.keep_asking(200, 100)
    bench.until_wheels(50, -50)
    service.report(why="bump")
    service.keep_asking(-200, -90)
    bench.until_wheels(-200, -90)
    service.keep_asking(-60, 60)
    bench.until_wheels(-60, 60)


def test_a_bump_while_driving_stops_within_a_few_frames(bench: Bench, service: FakeService) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)

    def bump() -> int:
        bench.create.sensors.bump_right = True
        return bench.create._now_ns

    pressed_ns = bench.emulator.call(bump)
    assert bench.until_wheels(0, 0) - pressed_ns < PATIENCE_NS


def test_a_create_that_its_own_safety_stopped_waits_for_somebodys_word(bench: Bench, service: FakeService) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    bench.emulator.call(lambda: setattr(bench.create.sensors, "drop_left", True))
    report = service.report(link="fallen")
    assert report["why"] == "mode"
    assert bench.create.wheels_mmps == (0, 0)
    bench.emulator.call(lambda: setattr(bench.create.sensors, "drop_left", False))
    service.report(link="fallen")  # not by itself, though nothing keeps it any more
    service.send({"recover": True})
    service.report(link="up")
    bench.until_wheels(200, 200)


def test_recovering_while_the_cause_is_still_there_does_not_help(bench: Bench, service: FakeService) -> None:
    bench.emulator.call(lambda: setattr(bench.create.sensors, "charger", True))
    service.report(link="fallen")
    service.send({"recover": True})
    service.report(link="waking")
    service.report(link="fallen")


def test_a_create_that_left_its_mode_for_no_reason_is_called_back_once(bench: Bench, service: FakeService) -> None:
    bench.emulator.call(lambda: bench.create.receive(bytes([135]), 57600, bench.create._now_ns))
    service.report(link="waking")
    bench.until_wheels(0, 0)  # the demo that a lost byte might have started
    service.report(link="up")
    bench.emulator.call(lambda: bench.create.receive(bytes([135]), 57600, bench.create._now_ns))
    service.report(link="fallen")


def test_a_create_that_was_switched_off_and_on_is_woken_again(bench: Bench, service: FakeService) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    bench.emulator.call(bench.create.power_cycle)
    service.report(link="waking")
    service.report(link="up")
    bench.until_wheels(200, 200)


def test_a_pulled_adapter_is_told_and_a_new_one_taken(bench: Bench, service: FakeService) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    bench.emulator.call(bench.line.port.unplug)
    report = service.report(link="closed")
    assert "plugged in" in report["why"]
    service.silence()
    bench.emulator.call(bench.line.port.plug)
    bench.until_wheels(0, 0)  # nothing could stop it while the line was cut; the first bytes do
    service.report(link="up")


def test_a_port_that_another_has_is_waited_for(bench: Bench, service: FakeService) -> None:
    with guarded(bench) as second:
        assert "another program" in second.report(link="closed")["why"]
        service.close()
        second.report(link="up")


def test_a_port_that_is_not_there_is_waited_for(bench: Bench) -> None:
    bench.emulator.call(bench.line.port.unplug)
    with guarded(bench) as service:
        assert "plugged in" in service.report(link="closed")["why"]
        bench.emulator.call(bench.line.port.plug)
        service.report(link="up")


def test_a_stopped_guard_that_goes_on_does_not_obey_what_is_over(bench: Bench, service: FakeService) -> None:
    os.kill(service.guard.pid, signal.SIGSTOP)
    service.ask(200, 200, for_s=0.05)
    bench.emulator.until(lambda: bench.create._now_ns > service.asked_ns + 60 * MS)
    os.kill(service.guard.pid, signal.SIGCONT)
    service.report(link="up")
    assert all(wheels == (0, 0) for _, wheels in bench.emulator.call(bench.create.acted.copy))
