"""One process under the supervisor: its start, its readiness, its restarts and its end."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from typing import IO

from cocoro import child
from cocoro.component import Component
from cocoro.errors import ConfigError
from deploy.contact import RECOVERY_S, SleepDetector
from deploy.heartbeat import Grace, Pulse
from deploy.launch import CRASHED, MISCONFIGURED, REFUSED
from deploy.processes import BACKOFF_LIMIT_S, SETTLED_S
from deploy.rundir import RunDir

EXPLAINED = (MISCONFIGURED, REFUSED)
"""Exit codes of processes whose last line of output is the whole explanation."""
LAST_BYTES = 8192
"""How much of a log's end is searched for its last lines."""
ENVIRONMENT = {
    # Matrices are small here: more threads would compete for the processors and add jitter.
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "PYTHONUNBUFFERED": "1",  # so that the log has the last output of a killed process
}
"""Defaults for a process's environment variables."""


class StartError(Exception):
    """A process did not become ready. `code` is the exit code for it."""

    def __init__(self, text: str, code: int = CRASHED) -> None:
        super().__init__(text)
        self.code = code if code in EXPLAINED else CRASHED


class SupervisedProcess:
    """Call `start`, then `keep` until the robot ends, then `stop`. Passes lines for people to `report`."""

    def __init__(
        self,
        row: Component,
        run_dir: RunDir,
        parent_fd: int,
        report: Callable[[str], None],
        sleep_detector: SleepDetector,
    ) -> None:
        """`sleep_detector` detects that the supervisor itself was asleep."""
        self.row = row
        self.restarts = 0
        self._run_dir = run_dir
        self._parent_fd = parent_fd
        self._report = report
        self._sleep_detector = sleep_detector
        self._delayed_report: asyncio.TimerHandle | None = None
        """Reports that contact is lost, unless the process is back by then."""
        self._alive: set[str] = set()
        self._ready = asyncio.Event()
        self._was_ready = False
        self._unheard = False
        """Whether contact with the living process is lost, as reported."""
        self._process: subprocess.Popen[bytes] | None = None
        self._pulse: Pulse | None = None
        self._exit: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._started_s = 0.0
        self._stopping = False

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process is not None and not self._exit.done() else None

    @property
    def exit_noticed(self) -> bool:
        """False when the process has ended and the event loop has not handled that yet."""
        if self._process is None or self._exit.done():
            return True
        try:
            return os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
        except ChildProcessError:
            return False

    async def start(self) -> None:
        """Start the process and wait until it is ready. Raises StartError when it ends before or takes too long."""
        self._spawn()
        if not await self._becomes_ready():
            if self._exit.done():
                code = self._exit.result()
                raise StartError(f"{self.row.name} {_ended(code)} at its start{self._last_words(code)}", code)
            missing = ", ".join(sorted(set(self.row.services) - self._alive))
            raise StartError(
                f"{self.row.name} was not ready after {self.row.start_s:g} s: no sign of {missing}{self._last_words()}"
            )
        self._report_ready()

    async def keep(self) -> None:
        """Restart the process as its policy says; returns when it is not restarted any more."""
        while True:
            code = await asyncio.shield(self._exit)
            if self._stopping:
                return
            lived_s = time.monotonic() - self._started_s
            restarted = self.row.restart == "always" or (self.row.restart == "on-failure" and code != 0)
            if not restarted:
                self._report(f"{self.row.name} {_ended(code)}; it is not restarted{self._last_words(code)}")
                return
            self.restarts = 1 if lived_s > SETTLED_S else self.restarts + 1
            wait_s = min(self.row.backoff_s * 2 ** (self.restarts - 1), BACKOFF_LIMIT_S)
            self._report(f"{self.row.name} {_ended(code)}; restart in {wait_s:g} s{self._last_words(code)}")
            await asyncio.sleep(wait_s)
            self._spawn()
            if await self._becomes_ready():
                self._report_ready()
            elif not self._exit.done():
                self._report(f"{self.row.name} was not ready after {self.row.start_s:g} s: killed")
                self._signal(signal.SIGKILL)

    async def stop(self) -> None:
        """End the process by SIGTERM, or by SIGKILL when it does not end in time. Returns when it has ended."""
        self._stopping = True
        if self.pid is None:
            return
        self._signal(signal.SIGTERM)
        self._signal(signal.SIGCONT)  # a stopped process could not handle SIGTERM
        with suppress(TimeoutError):
            async with asyncio.timeout(self.row.stop_s):
                await asyncio.shield(self._exit)
        if self._exit.done():
            self._report(f"{self.row.name} stopped")
            return
        self._signal(signal.SIGKILL)
        await self._exit
        self._report(f"{self.row.name} did not stop within {self.row.stop_s:g} s: killed")

    def on_alive(self, service: str, alive: bool) -> None:
        """Take the liveliness of one of its services from the mesh."""
        if alive:
            self._alive.add(service)
        else:
            self._alive.discard(service)
        ready = self._alive >= set(self.row.services)
        if ready:
            self._ready.set()
        else:
            self._ready.clear()
        self._report_contact(ready)

    def feel_pulse(self, passed_s: float, grace: Grace) -> None:
        """Kill the process when its event loop has not run for the grace, though it could; `keep` then restarts it. A
        process that is not ready yet has its time for that. `passed_s` is the time since the last call."""
        if self._pulse is None or self.pid is None or not self._was_ready or self._stopping:
            return
        self._pulse.feel(self.pid, passed_s)
        if self._pulse.hangs(grace):
            self._report(f"{self.row.name} hangs: its event loop has not run for {self._pulse.still_s:.0f} s; killed")
            self._signal(signal.SIGKILL)

    def _report_contact(self, ready: bool) -> None:
        """Report that contact with the process, which lives, is lost, or that it is back. After a sleep of the
        supervisor itself, a loss is reported only when it lasts."""
        if self._delayed_report is not None and ready:
            self._delayed_report.cancel()
            self._delayed_report = None
        if not self._was_ready or self.pid is None or self._stopping or ready != self._unheard:
            return
        if ready:
            self._unheard = False
            self._report(f"{self.row.name} is back")
        elif self._sleep_detector.look():
            if self._delayed_report is None:
                self._delayed_report = asyncio.get_running_loop().call_later(RECOVERY_S, self._report_lasting_loss)
        else:
            self._unheard = True
            missing = ", ".join(sorted(set(self.row.services) - self._alive))
            self._report(f"lost contact with {missing}: no sign of it on the mesh, though its process {self.pid} lives")

    def _report_lasting_loss(self) -> None:
        self._delayed_report = None
        self._report_contact(self._alive >= set(self.row.services))

    # --- the process ------------------------------------------------------------------------------

    def _spawn(self) -> None:
        loop = asyncio.get_running_loop()
        self._alive.clear()
        self._ready.clear()
        self._was_ready = False
        self._exit = loop.create_future()
        self._started_s = time.monotonic()
        pulse = self._pulse = Pulse()
        with self._log() as log:
            self._process = child.start(
                "deploy.launch",
                self.row.name,
                "--run-dir",
                str(self._run_dir.path),
                "--parent-fd",
                str(self._parent_fd),
                "--beat-fd",
                str(pulse.fd),
                stdout=log,
                stderr=log,
                env=ENVIRONMENT | os.environ,
                pass_fds=(self._parent_fd, pulse.fd),
                start_new_session=True,  # so that only the supervisor gets Ctrl-C of a terminal
            )
        pid_fd = os.pidfd_open(self._process.pid)
        loop.add_reader(pid_fd, self._on_exit, self._process, pid_fd)

    def _log(self) -> IO[bytes]:
        """The process's log file. When it cannot be written, that is reported, and the output goes nowhere."""
        try:
            return self._run_dir.new_log(self.row.name)
        except ConfigError as error:
            self._report(f"{self.row.name} runs without a log: {error}")
            return os.fdopen(os.open(os.devnull, os.O_WRONLY), "wb")

    def _on_exit(self, process: subprocess.Popen[bytes], pid_fd: int) -> None:
        asyncio.get_running_loop().remove_reader(pid_fd)
        os.close(pid_fd)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)  # its own children; the group's number is valid until it is reaped
        self._exit.set_result(process.wait())
        if self._pulse is not None:
            self._pulse.close()
            self._pulse = None
        self._alive.clear()
        self._ready.clear()
        self._was_ready = False

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None and not self._exit.done():  # it is not reaped yet, so the number is valid
            self._process.send_signal(number)

    async def _becomes_ready(self) -> bool:
        ready = asyncio.ensure_future(self._ready.wait())
        await asyncio.wait((ready, self._exit), timeout=self.row.start_s, return_when=asyncio.FIRST_COMPLETED)
        ready.cancel()
        return self._ready.is_set() and not self._exit.done()

    def _report_ready(self) -> None:
        self._was_ready, self._unheard = True, False
        services = "" if self.row.services == (self.row.name,) else f" ({', '.join(self.row.services)})"
        self._report(f"{self.row.name}{services} ready in {time.monotonic() - self._started_s:.1f} s")

    def _last_words(self, code: int | None = None) -> str:
        """The end of the log, to append to a sentence: the line that explains the exit code, or the last few lines."""
        log = self._run_dir.log(self.row.name)
        try:
            file = self._run_dir.open_log(self.row.name)
        except (FileNotFoundError, ConfigError):
            return ""
        with file:
            file.seek(max(file.seek(0, os.SEEK_END) - LAST_BYTES, 0))
            lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
        if code in EXPLAINED and lines:
            return f": {lines[-1].partition(f'{self.row.name}: ')[2] or lines[-1]}"
        return "".join(f"\n    {line}" for line in (f"{log}:", *lines[-3:]))


def _ended(code: int) -> str:
    if code < 0:
        return f"was killed by {signal.Signals(-code).name if -code in set(signal.Signals) else f'signal {-code}'}"
    return f"ended (exit code {code})"
