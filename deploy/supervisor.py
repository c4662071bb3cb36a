"""The supervisor, which `cocoro up` runs: starts the processes of a profile, watches them, and stops them.

Detached it is `python -m deploy.supervisor --run-dir DIR --report-fd N`, with the resolved profile on its standard
input. Until the robot is up it reports its progress through the pipe, one JSON object per line.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import msgspec

from cocoro.bus import shared
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CocoroError, ConfigError, RefusedError
from cocoro.keys import alive_key, service_of
from cocoro.stop.record import latch_dir, prepare
from cocoro.topics import HEALTH
from deploy import heartbeat, robot_time, service_manager
from deploy.contact import SleepDetector
from deploy.launch import CRASHED, Line
from deploy.processes import shared_bytes, stoppable
from deploy.profiles import Profile, from_data
from deploy.quit import quit_process
from deploy.rundir import RunDir
from deploy.supervised_process import StartError, SupervisedProcess
from deploy.survey import Onlooker, SurveyServer
from services.cockpit.component import COCKPIT

STOPPED, MISCONFIGURED, REFUSED = 0, 2, 3
"""Exit codes, as for every command."""
COMES_UP_STOPPED = "the robot comes up stopped, and `cocoro reset` releases it"
LEFTOVER_S = 8.0
"""Time in which the processes of a killed supervisor must notice that and end."""
TOLD_TRIES, TOLD_S = 3, 0.3
"""How often the cockpit is asked where its page is, and the longest wait for each answer."""

log = logging.getLogger(__name__)


class Supervisor:
    """The processes of one robot on this machine. Call `run`. Passes lines for people to `report`."""

    def __init__(
        self,
        profile: Profile,
        run_dir: RunDir,
        report: Callable[[str], None],
        on_up: Callable[[], None] = lambda: None,
        *,
        by_hand: bool = True,
    ) -> None:
        """`by_hand`: a person started it, not the machine when it booted."""
        self._profile = profile
        self._run_dir = run_dir
        self._by_hand = by_hand
        self._on_up = on_up
        self._report_to_people = report
        self._children: list[SupervisedProcess] = []
        self._firsts = [row for row in profile.rows() if row.first] if profile.clock == "real" else []
        self._stop = asyncio.Event()
        self._unshared = ""
        """Why not all frames fit into shared memory, as found before the processes were started."""
        self._sleep_detector = SleepDetector(self._report)
        self._grace = heartbeat.grace()

    async def run(self) -> int:
        """Start everything, wait for SIGINT or SIGTERM, stop everything. Returns the exit code.

        Raises RefusedError when the robot is up already, ConfigError when the mesh cannot be opened.
        """
        self._run_dir.make()
        held = self._run_dir.hold_supervisor(self._profile.name)
        try:
            self._log_to_file()
            await self._wait_for_leftovers()
            shared.sweep()  # segments of dead processes
            self._unshared = shared.obstacle(shared_bytes(self._profile.rows()))
            self._run_dir.remember(msgspec.json.format(msgspec.json.encode(self._profile)))
            self._prepare_latches()
            robot_time.fix(self._run_dir.path, settable=bool(self._firsts))
            with _signals(self._on_signal):
                return await self._run()
        finally:
            shared.sweep()  # segments of processes that were killed
            held.release()

    async def _run(self) -> int:
        code = STOPPED
        reader_fd, writer_fd = os.pipe()  # the children hold the reading end, and notice when this process ends
        try:
            async with await ZenohBus.open(self._run_dir.join_as("supervisor", self._profile.mesh)) as bus:
                self._children = [
                    SupervisedProcess(row, self._run_dir, reader_fd, self._report, self._sleep_detector)
                    for row in self._profile.rows()
                ]
                by_service = {service: child for child in self._children for service in child.row.services}

                def on_alive(key: str, alive: bool) -> None:
                    service = service_of(key)
                    if service in by_service:
                        by_service[service].on_alive(service, alive)

                bus.watch_alive(alive_key(self._profile.robot), on_alive)
                onlooker = Onlooker(self._run_dir, bus, private=not self._profile.shared)
                survey = SurveyServer(onlooker)
                await survey.open()
                detecting = asyncio.ensure_future(self._sleep_detector.keep())
                try:
                    code = await self._start_and_keep(onlooker)
                finally:
                    detecting.cancel()
                    survey.close()
                    service_manager.notify("STOPPING=1")
                    for child in reversed(self._children):
                        await child.stop()
        finally:
            os.close(writer_fd)
            os.close(reader_fd)
        return code

    async def _start(self) -> None:
        """Starts all processes, after those that the robot's time waits for. Raises StartError."""
        first = [child for child in self._children if child.row in self._firsts]
        await asyncio.gather(*(child.start() for child in first))
        if first and robot_time.origin(self._run_dir.path) == robot_time.ALONE:
            self._report("the robot's time here is this machine's own: the host that keeps it did not answer")
        await asyncio.gather(*(child.start() for child in self._children if child not in first))

    async def _start_and_keep(self, onlooker: Onlooker) -> int:
        starting = asyncio.ensure_future(self._start())
        stopping = asyncio.ensure_future(self._stop.wait())
        await asyncio.wait((starting, stopping), return_when=asyncio.FIRST_COMPLETED)
        stopping.cancel()
        if not starting.done():
            starting.cancel()
            with suppress(asyncio.CancelledError):
                await starting
            return REFUSED
        try:
            starting.result()
        except StartError as error:
            self._report(str(error))
            return error.code
        if self._unshared:
            self._report(f"no shared memory: {self._unshared}; {shared.COSTS}")
        await self._report_cockpit(onlooker)
        self._report(f"{self._profile.robot} is up ({self._profile.name})")
        self._on_up()
        service_manager.notify("READY=1")
        async with asyncio.TaskGroup() as group:
            keeping = [group.create_task(child.keep()) for child in self._children]
            keeping.append(group.create_task(service_manager.keep_watchdog(self._works)))
            if self._grace.hangs_s:
                keeping.append(group.create_task(self._feel_pulses()))
            await self._stop.wait()
            for task in keeping:
                task.cancel()
        return STOPPED

    async def _report_cockpit(self, onlooker: Onlooker) -> None:
        """Say where the cockpit's page is, or why there is none."""
        if COCKPIT.name not in self._profile.processes:
            return
        for _ in range(TOLD_TRIES):
            told = await onlooker.newest(HEALTH.of(COCKPIT.name), TOLD_S)
            if told and told[0].text:
                self._report(f"{COCKPIT.name}: {told[0].text}")
                return
            await asyncio.sleep(TOLD_S / TOLD_TRIES)

    async def _feel_pulses(self) -> None:
        """Kill processes that hang, for ever."""
        before_s = time.monotonic()
        while True:
            await asyncio.sleep(heartbeat.LOOK_S)
            now_s = time.monotonic()
            for child in self._children:
                child.feel_pulse(now_s - before_s, self._grace)
            before_s = now_s

    def _works(self) -> bool:
        """Whether this supervisor has noticed the end of every process that has ended."""
        return all(child.exit_noticed for child in self._children)

    async def _wait_for_leftovers(self) -> None:
        """Wait for the processes of a killed supervisor, which end by themselves. Raises RefusedError when one does
        not."""
        services = set(self._profile.services())
        deadline_s = asyncio.get_running_loop().time() + LEFTOVER_S
        while found := {service: by for service, by in self._run_dir.claims().items() if service in services}:
            if asyncio.get_running_loop().time() > deadline_s:
                who = ", ".join(f"{service} ({by.name}, pid {by.pid})" for service, by in found.items())
                raise RefusedError(f"{self._profile.robot} runs already: {who}; `cocoro down` ends it")
            await asyncio.sleep(0.05)

    def _prepare_latches(self) -> None:
        """Prepare the emergency stop's record on the disk before anything moves."""
        services = {*self._profile.services()} & {*stoppable(), "executive"}
        folder = latch_dir(self._profile.robot)
        try:
            records = prepare(folder, services, by_hand=self._by_hand)
        except OSError as error:
            self._report(
                f"the emergency stop's latch cannot be kept in {folder}: {error.strerror or error}; {COMES_UP_STOPPED}"
            )
            return
        latched = next((record for record in records.values() if record.latched), None)
        if latched is not None:
            when = f", {latched.when}" if latched.when else ""
            self._report(f"the emergency stop is latched by {latched.by}{when}; {COMES_UP_STOPPED}")

    def _on_signal(self, number: signal.Signals) -> None:
        self._report("still stopping" if self._stop.is_set() else f"stopping ({number.name})")
        self._stop.set()

    def _report(self, text: str) -> None:
        log.info("%s", text)
        self._report_to_people(text)

    def _log_to_file(self) -> None:
        handler = _log_handler(self._run_dir, self._report_to_people)
        handler.setFormatter(Line("supervisor"))
        log.handlers[:] = [handler]
        log.setLevel(logging.INFO)
        log.propagate = False


class _Log(logging.StreamHandler[IO[str]]):
    """Reports once that the log cannot be written any more, and continues without it."""

    def __init__(self, stream: IO[str], path: Path, report: Callable[[str], None]) -> None:
        super().__init__(stream)
        self._path = path
        self._report = report
        self._reported = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 # the library's name
        if not self._reported:
            self._reported = True
            self._report(f"{self._path} cannot be written ({sys.exc_info()[1]}): the supervisor works on without")


def _log_handler(run_dir: RunDir, report: Callable[[str], None]) -> logging.Handler:
    try:
        file = run_dir.new_log("supervisor")
    except ConfigError as error:
        report(f"the supervisor runs without a log: {error}")
        return logging.NullHandler()
    return _Log(io.TextIOWrapper(file, write_through=True), run_dir.log("supervisor"), report)


@contextmanager
def _signals(handler: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Within this context, pass SIGINT, SIGTERM and a closed terminal (SIGHUP) to `handler`."""
    loop = asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup ignores it
        numbers.append(signal.SIGHUP)
    for number in numbers:
        loop.add_signal_handler(number, handler, number)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)


def supervise(
    profile: Profile,
    run_dir: RunDir,
    report: Callable[[str], None],
    on_up: Callable[[], None] = lambda: None,
    *,
    by_hand: bool = True,
) -> int:
    """Run a robot in the foreground; returns the exit code. Passes lines for people to `report`."""

    async def run() -> int:
        return await Supervisor(profile, run_dir, report, on_up, by_hand=by_hand).run()

    try:
        return asyncio.run(run())
    except RefusedError as error:
        report(str(error))
        return REFUSED
    except CocoroError as error:
        report(str(error))
        return MISCONFIGURED


class _Pipe:
    """Reports to the command that started this process, until the robot is up."""

    def __init__(self, fd: int) -> None:
        self._file = os.fdopen(fd, "w", buffering=1)

    def line(self, text: str) -> None:
        self._write({"line": text})

    def close(self, code: int) -> None:
        self._write({"code": code})
        with suppress(OSError):
            self._file.close()

    def _write(self, message: dict[str, object]) -> None:
        with suppress(OSError, ValueError):  # the command has ended
            self._file.write(json.dumps(message) + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m deploy.supervisor", description="Run a robot, detached.")
    parser.add_argument("--run-dir", type=Path, required=True, help="the robot's folder")
    parser.add_argument("--report-fd", type=int, required=True, help="a pipe for reports until the robot is up")
    parser.add_argument("--unattended", action="store_true", help="no person started it")
    options = parser.parse_args()
    pipe = _Pipe(options.report_fd)
    data = json.loads(sys.stdin.buffer.read())
    profile = from_data(data, data.get("name", ""))
    run_dir = RunDir(profile.robot, options.run_dir.parent)
    by_hand = not options.unattended
    try:
        code = supervise(profile, run_dir, pipe.line, on_up=lambda: pipe.close(STOPPED), by_hand=by_hand)
    except OSError as error:  # the traceback goes to supervisor.err, unless that is on the same full disk
        pipe.line(f"{error.filename or run_dir.path}: {error.strerror}; mend it, or choose another by COCORO_RUN_DIR")
        pipe.close(CRASHED)
        raise
    pipe.close(code)
    return code


if __name__ == "__main__":
    quit_process(main())
