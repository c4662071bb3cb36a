"""Runs the tests on forked workers: `pytest --spread`, as `make test` does.

This process imports and collects all tests once and forks the workers, which share that memory and need no time for it:
a process that collects by itself, as each worker of pytest-xdist does, takes 2.8 s of processor time and 199 MB for
that. Nor has pytest-xdist workers of unlike kinds, with a scheduling class and a network of their own. Each worker
takes one file after another, so that what the tests of a file share is made once, and reports to this process.

- `others`: tests without the marker `zenoh`, on two workers that get only the processor time that is left (SCHED_IDLE,
  and a session of the least weight, since Linux shares the processor between sessions first), during all the rest.
- `alone`: tests that measure real time closely, one by one.
- `beside`: after them the other tests with `zenoh`, on two workers, since they wait more than they compute.

The process that forks gives a worker its next file, the longest for which there is memory (`run_room.py`).

Each worker has a network of its own, so that an emergency stop of its tests reaches no robot of another one. Where
that is not allowed (only root may), the third kind has one worker.

A worker that has more than `GROWN_MB` of its own ends after its file, and another one takes its place. When one dies,
the test that it ran fails, and so do the others of its file that it had not begun.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import gc
import os
import pickle
import select
import signal
import socket
import struct
import subprocess
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from run_memory import memory_mb
from run_record import memory_mb as resident_mb
from run_room import Job, Room, jobs_of

WORKERS = {"others": 2, "alone": 1, "beside": 2}
GROWN_MB = 80.0
"""Memory that it does not share: what it has made, and what it has written to of the memory that it shared at first."""
CHECKS = "COCORO_TESTS_CHECKS"
"""Environment variable: the process that checks types and import rules meanwhile."""
CHECKS_MB = 660.0
"""What mypy takes without its cache."""
LEFT_MB = 20.0
"""When a test leaves more, it is given back before the next one: a simulated robot leaves up to 50 MB in cycles of
objects, and the allocator keeps as much."""
NEW_NETWORK = 0x40000000
"""CLONE_NEWNET, see unshare(2)."""
SET_FLAGS, UP, RUNNING = 0x8914, 0x1, 0x40
"""SIOCSIFFLAGS, IFF_UP and IFF_RUNNING, see netdevice(7)."""
END_S = 20.0
"""Longest wait for workers to end after Ctrl-C."""
_LENGTH, _NUMBER = struct.Struct("!I"), struct.Struct("!I")


def kind_of(item: pytest.Item) -> str:
    if item.get_closest_marker("zenoh") is None:
        return "others"
    return "beside" if item.get_closest_marker("alone") is None else "alone"


def jobs_by_kind(items: Iterable[pytest.Item], record: Path | None = None) -> dict[str, list[Job]]:
    by_kind: dict[str, list[pytest.Item]] = {kind: [] for kind in WORKERS}
    for item in items:
        by_kind[kind_of(item)].append(item)
    return {kind: jobs_of(of_kind, record) for kind, of_kind in by_kind.items()}


@dataclass
class Worker:
    """A forked process, as the other one sees it."""

    kind: str
    pid: int
    reports: int
    """The pipe from which its messages are read."""
    orders: int
    """The pipe to which the number of its next file is written; its end ends the worker."""
    idle: bool = False
    left: list[str] = field(default_factory=list)
    """The tests of its file that have not ended; it runs the first."""
    data: bytearray = field(default_factory=bytearray)
    grown: bool = False

    def close(self) -> None:
        os.close(self.reports)
        self.order_no_more()

    def order_no_more(self) -> None:
        if self.orders >= 0:
            os.close(self.orders)
            self.orders = -1


class Spread:
    """The plugin of the process that forks."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._workers: dict[int, Worker] = {}
        self._jobs: dict[str, list[Job]] = {}
        self._room = Room({})
        self._checks = -1
        """The process that checks types meanwhile, until its end."""
        self._forked = 0

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        if session.testsfailed or self._config.option.collectonly:
            return None  # pytest itself says so
        record = self._config.pluginmanager.getplugin("record of the run")
        self._jobs = jobs_by_kind(session.items, None if record is None else record.last)
        self._room = Room(
            {kind: [(number, job.need_mb) for number, job in enumerate(jobs)] for kind, jobs in self._jobs.items()}
        )
        with contextlib.suppress(KeyError, ProcessLookupError):
            self._checks = os.pidfd_open(int(os.environ.pop(CHECKS)))
            self._room.runs[self._checks] = "checks", CHECKS_MB
        may_be_alone()  # found out once for all
        Path(self._config._tmp_path_factory.getbasetemp()).mkdir(exist_ok=True)  # type: ignore[attr-defined]
        gc.collect()
        gc.freeze()  # the collector would touch, and so copy, what the workers share
        try:
            self._start("others")
            for kind in ("alone", "beside"):
                self._start(kind)
                self._listen(session, lambda kind=kind: self._runs(kind))  # type: ignore[misc]
            self._listen(session, lambda: self._runs("others"))
        finally:
            gc.unfreeze()
            self._end()
        return True

    def _runs(self, kind: str) -> bool:
        return any(worker.kind == kind for worker in self._workers.values())

    def _start(self, kind: str) -> None:
        count = WORKERS[kind] if kind != "beside" or may_be_alone() else 1
        for _ in range(min(count, len(self._jobs[kind]))):
            self._fork(kind)

    def _fork(self, kind: str) -> None:
        (reader, writer), (orders, to_order) = os.pipe(), os.pipe()
        self._forked += 1
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.close(reader)
                os.close(to_order)
                for other in self._workers.values():
                    other.close()
                work(self._config, f"{kind}-{self._forked}", kind, orders, self._jobs[kind], writer)
                code = 0
            except KeyboardInterrupt:
                pass
            except BaseException:
                Teller(self._config, writer).tell("broken", traceback.format_exc())
            finally:
                os._exit(code)
        os.close(writer)
        os.close(orders)
        self._workers[reader] = Worker(kind, pid, reader, to_order)

    def _order(self) -> None:
        """Give idle workers what they may begin, and end those for which there is nothing left."""
        idle = {fd: worker for fd, worker in self._workers.items() if worker.idle}
        while (order := self._room.next_for((fd, worker.kind) for fd, worker in idle.items())) is not None:
            worker = idle.pop(order[0])
            worker.idle = False
            worker.left = [item.nodeid for item in self._jobs[worker.kind][order[1]].items]
            with contextlib.suppress(BrokenPipeError):  # it has just died, which is told when its reports end
                os.write(worker.orders, _NUMBER.pack(order[1]))
        for worker in idle.values():
            if not self._room.waiting[worker.kind]:
                worker.order_no_more()

    # --- what they report -------------------------------------------------------------------------

    def _listen(self, session: pytest.Session, goes_on: Callable[[], bool]) -> None:
        while goes_on():
            watched = [*self._workers, *([self._checks] if self._checks >= 0 else [])]
            for fd in select.select(watched, [], [])[0]:
                if fd == self._checks:
                    self._room.ended(fd)
                    os.close(fd)
                    self._checks = -1
                    continue
                worker = self._workers[fd]
                data = os.read(fd, 1 << 20)
                worker.data += data
                for message in _messages(worker.data):
                    self._take(worker, message)
                if not data:
                    self._ended(worker)
                if session.shouldfail:
                    raise session.Failed(session.shouldfail)
            self._order()

    def _take(self, worker: Worker, message: tuple[str, Any]) -> None:
        what, content = message
        if what == "idle":
            worker.idle = True
            self._room.ended(worker.reports)
        elif what == "report":
            hook = self._config.hook
            hook.pytest_runtest_logreport(
                report=hook.pytest_report_from_serializable(config=self._config, data=content)
            )
        elif what == "done":
            worker.left.remove(content)
        elif what == "grown":
            worker.grown = True
        else:
            raise RuntimeError(f"a worker failed by itself:\n{content}")

    def _ended(self, worker: Worker) -> None:
        del self._workers[worker.reports]
        self._room.ended(worker.reports)
        worker.close()
        status = os.waitstatus_to_exitcode(os.waitpid(worker.pid, 0)[1])
        for place, nodeid in enumerate(worker.left):
            what = "while this test ran" if place == 0 else "before this test"
            said = f"its worker ended {what} ({_name(status)})"
            report = pytest.TestReport(nodeid, (nodeid.partition("::")[0], None, nodeid), {}, "failed", said, "call")
            self._config.hook.pytest_runtest_logreport(report=report)
        if worker.grown or worker.left:
            self._fork(worker.kind)

    def _end(self) -> None:
        for worker in self._workers.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGINT)
        for worker in self._workers.values():
            pid_fd = os.pidfd_open(worker.pid)
            if not select.select([pid_fd], [], [], END_S)[0]:
                os.kill(worker.pid, signal.SIGKILL)
            os.close(pid_fd)
            os.waitpid(worker.pid, 0)


def _messages(data: bytearray) -> Iterator[tuple[str, Any]]:
    """The whole messages in what was read; removes them from it."""
    while len(data) >= _LENGTH.size and len(data) >= (end := _LENGTH.size + _LENGTH.unpack_from(data)[0]):
        message: tuple[str, Any] = pickle.loads(data[_LENGTH.size : end])
        del data[:end]
        yield message


def _name(status: int) -> str:
    return signal.Signals(-status).name if status < 0 else f"exit code {status}"


# --- the worker -----------------------------------------------------------------------------------


class Teller:
    """The plugin of a worker: sends what it has to tell, in place of printing it."""

    def __init__(self, config: pytest.Config, writer: int) -> None:
        self._config = config
        self._writer = writer

    def tell(self, what: str, content: Any = None) -> None:
        data = pickle.dumps((what, content))
        data = _LENGTH.pack(len(data)) + data
        while data:
            data = data[os.write(self._writer, data) :]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self.tell("report", data)


def work(config: pytest.Config, name: str, kind: str, orders: int, jobs: list[Job], writer: int) -> None:
    """Runs one file after another, as ordered."""
    os.setsid()  # Ctrl-C comes from the process that forked, once
    if kind == "others":
        step_back()
    if may_be_alone():
        be_alone()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    plugins = config.pluginmanager
    capture = plugins.getplugin("capturemanager")
    if capture is not None:  # its files are shared with the other workers
        capture.stop_global_capturing()
        capture.start_global_capturing()
    teller = Teller(config, writer)
    plugins.unregister(plugins.getplugin("terminalreporter"))
    plugins.register(teller)
    temporary: Any = config._tmp_path_factory  # type: ignore[attr-defined]
    temporary._basetemp = temporary.getbasetemp() / name
    temporary._basetemp.mkdir(mode=0o700)
    if (record := plugins.getplugin("record of the run")) is not None:
        record.begin()
    while True:
        teller.tell("idle")
        if not (number := os.read(orders, _NUMBER.size)):
            return
        items = jobs[_NUMBER.unpack(number)[0]].items
        kept_mb = resident_mb()
        try:
            for item, after in zip(items, [*items[1:], None], strict=True):
                config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                teller.tell("done", item.nodeid)
                if resident_mb() > kept_mb + LEFT_MB:
                    give_back()
                    kept_mb = resident_mb()
        except KeyboardInterrupt:
            items[0].session._setupstate.teardown_exact(None)  # so that its fixtures end
            raise
        give_back()
        if memory_mb(Path("/proc/self")).own > GROWN_MB:
            teller.tell("grown")
            return


def give_back() -> None:
    """Returns to the system what nobody uses any more."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


@cache
def may_be_alone() -> bool:
    """Whether this process may have a network of its own."""
    return os.geteuid() == 0 and subprocess.run(["unshare", "--net", "true"], capture_output=True).returncode == 0


def be_alone() -> None:
    """Moves this process to a network of its own, with a loopback device."""
    if ctypes.CDLL(None, use_errno=True).unshare(NEW_NETWORK):
        raise OSError(ctypes.get_errno(), "unshare(2)")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SET_FLAGS, struct.pack("16sh14x", b"lo", UP | RUNNING))


def step_back() -> None:
    """Leaves the processor to all other sessions, as far as the system allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("19")
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--spread", action="store_true", help="run the tests on forked workers, by their markers")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--spread"):
        config.pluginmanager.register(Spread(config), "spread")
