"""Tries faults at the ends of emulated wires while a robot moves: `python -m bench hardware-faults [--count 1000]`.

The services run in a separate process (`bench.hardware_driver`), which keeps wheels and joints moving; this process
emulates the hardware. Each fault is caused, observed from the hardware's side and ended. Then the robot must move again
without a restart (unless its process was killed). Counted for each kind:

- crashes: the services' process ended by itself;
- wrong: wheel speeds or goals that were not commanded. The Create cannot detect damaged bytes, because its commands
  have no checksum; their effects are counted separately, with their duration;
- stops: time that the wheels went on after link or service were lost (limit 0.3 s);
- unseen: not reported in the health of the services, which `cocoro status` shows;
- stuck: did not move again in time.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from bench.hardware_driver import REACH_RAD, WHEELS
from bench.hardware_rig import LINES, MS, NS, ROBOT, Hardware, Services
from bench.report import Report, Table
from bench.trials import number_of, sized
from sim.wire.line import KINDS, LineFault
from sim.wire.servo import EmulatedServo

STOP_NS = 300 * MS
AGAIN_S = 40.0
FAR_NS = 10**19
SPEEDS = {(round(1000 * left), round(1000 * right)) for left, right in WHEELS}
TURNS = {((left - right) // 2, -((left - right) // 2)) for left, right in SPEEDS}
"""Wheel speeds that the reflexes may make of the commanded ones, mm/s."""
TRIED, CRASHES, WRONG = "faults", "the services' process ended by itself", "wheels or goals that were not commanded"
STUCK, SLOWEST = "did not move again", "the slowest stop"
"""Names of figures."""
GOOD_WHEELS = SPEEDS | TURNS | {(0, 0)}


@dataclass
class Tally:
    tried: int = 0
    crashes: int = 0
    wrong: int = 0
    garbled: int = 0
    garbled_longest_ms: float = 0.0
    late_stops: int = 0
    slowest_stop_ms: float = 0.0
    unseen: int = 0
    stuck: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        return not (self.crashes or self.wrong or self.late_stops or self.unseen or self.stuck)


@dataclass
class Trial:
    """One fault: its start, its duration, its end, and the expected reaction."""

    name: str
    begin: Callable[[], None]
    end: Callable[[], None]
    for_s: float
    shown: tuple[str, ...]
    """One of these texts must be reported; empty when no report is required."""
    stops: bool = False
    """Whether the wheels must stop within the limit."""
    garbles: bool = False
    """Whether bytes to the Create are damaged."""
    kills: bool = False


class Campaign:
    def __init__(self, hardware: Hardware, services: Services, seed: int) -> None:
        self._hardware = hardware
        self._services = services
        self._draws = random.Random(seed)
        self.tallies: dict[str, Tally] = {}
        kinds: list[Callable[[], Trial]] = [self._line] * 18
        kinds += [self._unplug] * 3
        kinds += [self._overload, self._mute, self._brown_out, self._heat, self._undervoltage]
        kinds += [self._drop, self._charger, self._cliff, self._bump, self._demo, self._power_cycle, self._battery_low]
        kinds += [self._kill_service, self._stop_service, self._kill_guard, self._stop_guard]
        self._kinds = kinds

    def run(self, count: int, tell: Callable[[str], None]) -> None:
        self._until_moving()
        for number in range(count):
            trial = self._draws.choice(self._kinds)()
            tally = self.tallies.setdefault(trial.name, Tally())
            bad = tally.good
            self._try(trial, tally)
            if bad and not tally.good:
                tell(f"{number}: {trial.name}: {tally}")
            if (number + 1) % 50 == 0:
                tell(f"{number + 1} faults")

    def _try(self, trial: Trial, tally: Tally) -> None:
        tally.tried += 1
        _pause(self._draws.uniform(0.0, 0.8))
        self._hardware.wheel_log()
        self._hardware.wrong_goals()
        began_ns = time.monotonic_ns()
        trial.begin()
        if trial.stops:
            self._await_stop(began_ns, tally)
        seen = not trial.shown or self._services.shows(trial.shown)
        _pause(max(trial.for_s - (time.monotonic_ns() - began_ns) / NS, 0.0))
        trial.end()
        if trial.kills:
            self._services.start()
        if not seen:
            tally.unseen += 1
        moving = self._until_moving()
        self._judge(trial, tally)
        if not self._services.alive:
            tally.crashes += 1
            tally.notes.append(self._services.last_words())
            self._services.start()
            self._until_moving()
        elif not moving:
            tally.stuck += 1
            tally.notes.append(self._state())
            self._services.kill()
            self._hardware.emulator.call(self._hardware.create.power_cycle)
            self._services.start()
            self._until_moving()

    def _await_stop(self, began_ns: int, tally: Tally) -> None:
        """The time of the stop comes from the emulator's log, since this process may notice it late."""
        create = self._hardware.create
        try:
            self._hardware.emulator.until(lambda: create.wheels_mmps == (0, 0), 5.0)
            log = self._hardware.emulator.call(create.acted.copy)
            stopped_ns = next((at_ns for at_ns, wheels in log if wheels == (0, 0) and at_ns > began_ns), began_ns)
        except TimeoutError:
            stopped_ns = began_ns + 5 * NS
            tally.notes.append(f"not stopped: {self._state()}")
        took_ms = (stopped_ns - began_ns) / MS
        tally.slowest_stop_ms = max(tally.slowest_stop_ms, took_ms)
        tally.late_stops += took_ms > STOP_NS / MS

    def _judge(self, trial: Trial, tally: Tally) -> None:
        """Compare the commands that reached wheels and joints with those that were given."""
        wrong = self._hardware.wrong_goals()
        tally.notes += wrong[:3]
        tally.wrong += len(wrong)
        log = self._hardware.wheel_log()
        ends = [*(at_ns for at_ns, _ in log[1:]), time.monotonic_ns()]
        for (at_ns, wheels), end_ns in zip(log, ends, strict=False):
            if wheels in GOOD_WHEELS:
                continue
            if trial.garbles:
                tally.garbled += 1
                tally.garbled_longest_ms = max(tally.garbled_longest_ms, (end_ns - at_ns) / MS)
            else:
                tally.wrong += 1
                tally.notes.append(f"wheels {wheels}")

    def _until_moving(self) -> bool:
        """Wait until wheels and joints move again; does the operator's part (recover, clear)."""
        create, servos = self._hardware.create, self._hardware.servos
        moved = [ROBOT.joints[joint].id for joint in REACH_RAD]
        end_s = time.monotonic() + AGAIN_S
        while time.monotonic() < end_s:
            goals = self._hardware.emulator.call(lambda: {number: servos[number].get(30) for number in moved})
            if not self._services.alive:
                return False
            self._services.say("recover")
            self._services.say("clear")
            try:
                self._hardware.emulator.until(
                    lambda goals=goals: (
                        create.wheels_mmps in SPEEDS  # type: ignore[misc]
                        and not create.deaf
                        and all(servos[number].motor.on and servos[number].get(30) != goals[number] for number in moved)
                    ),
                    2.5,
                )
                return True
            except TimeoutError:
                continue
        return False

    def _state(self) -> str:
        """The state of hardware that does not move, for the report."""
        create, servos = self._hardware.create, self._hardware.servos
        reports: list[Any] = []
        while not self._services.reports.empty():
            reports.append(self._services.reports.get())
        limp = [number for number, servo in servos.items() if not servo.motor.on]
        received = f"pending {create.pending.hex()}{', deaf' if create.deaf else ''}"
        return f"mode {create.mode}, baud {create.baud}, {received}, limp {limp}, {reports[-1:]}"

    # --- the faults -----------------------------------------------------------------------------------

    def _call(self, job: Callable[[], object]) -> None:
        self._hardware.emulator.call(job)

    def _line(self) -> Trial:
        draws, name, kind = self._draws, self._draws.choice(LINES), self._draws.choice(KINDS)
        way: Literal["to_device", "to_driver"] = draws.choice(("to_device", "to_driver"))
        share = draws.uniform(0.003, 0.05) if kind in ("lost", "corrupted") else draws.uniform(0.05, 0.4)
        line = self._hardware.emulator.lines[name]
        fault = LineFault(kind, share, way, FAR_NS, round(draws.uniform(5, 80) * MS))
        cut = kind == "silent"
        shown: tuple[str, ...] = ("disturbed",)
        if cut:
            shown = ("does not answer",) if way == "to_driver" or name != "create" else ("disturbed",)
        elif kind in ("late", "repeated"):
            shown = ()  # bytes that are late or doubled are not damaged
        elif name != "create" and way == "to_device":
            shown = ("disturbed", "does not answer")

        def end() -> None:
            self._call(line.undisturb)
            if name == "create":  # a flipped bit may form the command that changes the baud rate
                self._call(lambda: setattr(self._hardware.create, "baud", 57600))

        return Trial(
            f"{name}: {kind} {way.replace('_', ' ')}",
            lambda: self._call(lambda: line.disturb(fault)),
            end,
            draws.uniform(0.5, 1.5),
            shown,
            stops=cut and name == "create" and way == "to_driver",
            garbles=name == "create" and way == "to_device",
        )

    def _unplug(self) -> Trial:
        name = self._draws.choice(LINES)
        port = self._hardware.emulator.lines[name].port
        return Trial(
            f"{name}: unplugged", lambda: self._call(port.unplug), lambda: self._call(port.plug),
            self._draws.uniform(0.2, 1.0), ("plugged in",),
        )  # fmt: skip

    def _servo(self) -> EmulatedServo:
        return self._hardware.servos[ROBOT.joints[self._draws.choice(list(REACH_RAD))].id]

    def _overload(self) -> Trial:
        servo = self._servo()
        return Trial("servo: overload", lambda: self._call(lambda: servo.trip(32)), _nothing, 0.3, ("overload",))

    def _heat(self) -> Trial:
        servo = self._servo()

        def begin() -> None:
            self._call(lambda: servo.put(43, 90))

        return Trial("servo: overheating", begin, lambda: self._call(lambda: servo.put(43, 40)), 0.5, ("overheating",))

    def _mute(self) -> Trial:
        servo = self._servo()
        return Trial(
            "servo: plug out", lambda: self._call(lambda: setattr(servo, "mute", True)),
            lambda: self._call(lambda: setattr(servo, "mute", False)), 0.5, ("does not answer",),
        )  # fmt: skip

    def _brown_out(self) -> Trial:
        servo = self._servo()
        return Trial("servo: brown-out", lambda: self._call(servo.power_up), _nothing, 0.3, ("lost its settings",))

    def _undervoltage(self) -> Trial:
        servo = self._servo()

        def end() -> None:
            self._call(lambda: servo.put(42, 120))
            self._call(servo.power_up)

        return Trial("servo: power lost", lambda: self._call(lambda: servo.put(42, 30)), end, 0.5, ("does not answer",))

    def _feel(self, name: str, field_name: str, value: object, shown: str, *, stops: bool) -> Trial:
        around = self._hardware.create.sensors
        before = getattr(around, field_name)
        return Trial(
            f"create: {name}", lambda: self._call(lambda: setattr(around, field_name, value)),
            lambda: self._call(lambda: setattr(around, field_name, before)),
            self._draws.uniform(0.2, 1.0), (shown,), stops=stops,
        )  # fmt: skip

    def _drop(self) -> Trial:
        return self._feel("wheel drop", "drop_left", True, "fell back", stops=True)

    def _charger(self) -> Trial:
        return self._feel("charger", "charger", True, "fell back", stops=True)

    def _cliff(self) -> Trial:
        return self._feel("cliff", "cliffs", [False, True, False, False], "cliff", stops=False)

    def _bump(self) -> Trial:
        return self._feel("bump", "bump_left", True, "stopped by bump", stops=False)

    def _battery_low(self) -> Trial:
        return self._feel("battery low", "charge_mah", 150, "battery is low", stops=False)

    def _demo(self) -> Trial:
        create = self._hardware.create
        return Trial(
            "create: leaves its mode", lambda: self._call(lambda: create.receive(bytes([131, 128]), create.baud, 0)),
            _nothing, 0.3, (), stops=True,
        )  # fmt: skip

    def _power_cycle(self) -> Trial:
        create = self._hardware.create
        return Trial("create: brown-out", lambda: self._call(create.power_cycle), _nothing, 0.3, (), stops=True)

    def _kill_service(self) -> Trial:
        return Trial("service: SIGKILL", self._services.kill, _nothing, 0.5, (), stops=True, kills=True)

    def _stop_service(self) -> Trial:
        process = self._services.process
        return Trial(
            "service: SIGSTOP", lambda: process.send_signal(signal.SIGSTOP),
            lambda: process.send_signal(signal.SIGCONT), self._draws.uniform(0.5, 1.5), (), stops=True,
        )  # fmt: skip

    def _signal_guard(self, number: signal.Signals) -> None:
        pid = self._services.guard_pid()
        if pid is not None:
            os.kill(pid, number)

    def _kill_guard(self) -> Trial:
        return Trial("guard: SIGKILL", lambda: self._signal_guard(signal.SIGKILL), _nothing, 0.5, (), stops=True)

    def _stop_guard(self) -> Trial:
        return Trial("guard: SIGSTOP", lambda: self._signal_guard(signal.SIGSTOP), _nothing, 0.8, (), stops=True)


def _nothing() -> None:
    pass


def _pause(seconds: float) -> None:
    threading.Event().wait(seconds)


def run(count: int, seed: int, tell: Callable[[str], None]) -> dict[str, Tally]:
    """What came of so many faults, by kind. Says what goes wrong, and the progress."""
    with tempfile.TemporaryDirectory(prefix="cocoro") as name:
        folder = Path(name)
        hardware = Hardware(folder, seed)
        with hardware.emulator:
            services = Services(folder)
            campaign = Campaign(hardware, services, seed)
            try:
                campaign.run(count, tell)
            finally:
                services.kill()
            return campaign.tallies


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="faults (100)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    found = run(sized(chosen, chosen.count, 100, 4), chosen.seed, report.say)
    tallies = [found[name] for name in sorted(found)]
    report.value(TRIED, [sum(tally.tried for tally in tallies)], "faults")
    for name, counted in (
        (CRASHES, [tally.crashes for tally in tallies]),
        (WRONG, [tally.wrong for tally in tallies]),
        ("stops that came late", [tally.late_stops for tally in tallies]),
        ("not reported", [tally.unseen for tally in tallies]),
        (STUCK, [tally.stuck for tally in tallies]),
    ):
        report.value(name, [sum(counted)], "times", at_most=0)
    report.value(SLOWEST, [max(tally.slowest_stop_ms for tally in tallies)], "ms")
    report.value("commands from damaged bytes to the Create", [sum(tally.garbled for tally in tallies)], "times")
    longest_ms = max(tally.garbled_longest_ms for tally in tallies)
    report.value("the longest effect of one", [longest_ms], "ms")
    report.notes += [f"{name}: {note}" for name in sorted(found) for note in found[name].notes[:2]]
    head = ["fault", "tried", "crash", "wrong", "garbled", "longest, ms", "late", "slowest, ms", "unseen", "stuck"]
    rows = [[name, *_row(found[name])] for name in sorted(found)]
    report.tables.append(Table("By kind", head, rows))


def _row(tally: Tally) -> list[str]:
    numbers = (
        tally.tried, tally.crashes, tally.wrong, tally.garbled, round(tally.garbled_longest_ms), tally.late_stops,
        round(tally.slowest_stop_ms), tally.unseen, tally.stuck,
    )  # fmt: skip
    return [str(number) for number in numbers]
