"""The run directory: what of a robot runs on this machine. One folder a robot, below one place for them all.

    <run>/<robot>/profile.json     the resolved profile of the last start
                  clock.json       the robot's time (see deploy.robot_time)
                  supervisor       held by the supervisor
                  claims/<service> held by the process that is that service
                  logs/            one file a process, of the last starts (or in $COCORO_LOG_DIR/<robot>)
                  (and the mesh's own register, see cocoro.bus.endpoints)

"Held" means locked for as long as its process lives, however that ends: so a process number that is read from a
held file is that process, and never one that got the number later.

The folders are this user's alone, and so are the files in them (see `cocoro.private`): what is not is refused with a
ConfigError, and when the place is full, what must be written raises FullError.
"""

from __future__ import annotations

import fcntl
import json
import os
import random
import select
import signal
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import IO, Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from cocoro import private
from cocoro.bus.endpoints import ZenohConfig, default, default_run_dir
from cocoro.bus.members import Who, members
from cocoro.errors import RefusedError

LOG_DIR = "COCORO_LOG_DIR"
"""Environment variable with a place for the logs that outlives the run directory."""
LOOK_S = 1.0
"""Longer than anyone takes to look who holds a file."""
PROFILE_BYTES = 1024 * 1024
"""More than any profile has."""
KEPT_LOGS = 5
"""Of earlier starts, for each process."""


class Mesh(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a robot's processes meet: a profile's `[mesh]` table. Without endpoints it is the run directory; the
    fields are those of `cocoro.bus.endpoints.ZenohConfig`."""

    mode: Literal["peer", "client", "router"] = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    lease_s: Annotated[float, Meta(gt=0)] = 4.0
    patience_s: Annotated[float, Meta(gt=0)] = 1.0
    options: dict[str, Any] = {}


class Holder(NamedTuple):
    """Who holds a file."""

    name: str
    pid: int


class Held:
    """A held file. `release` gives it back; so does the end of the process."""

    def __init__(self, fd: int) -> None:
        self._fd: int | None = fd

    def release(self) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)


def hold(path: Path, name: str) -> Held | None:
    """Hold a file in the name of this process; None when another one holds it. Raises ConfigError, FullError."""
    fd = private.open_file(path, os.O_CREAT | os.O_RDWR, make=True)
    about = json.dumps({"name": name, "pid": os.getpid()}).encode()
    deadline_s = time.monotonic() + LOOK_S
    while not _locked(fd, fcntl.LOCK_EX):
        if not _locked(fd, fcntl.LOCK_SH) or time.monotonic() > deadline_s:
            os.close(fd)
            return None
        # Nobody holds it: somebody only looks, as `holder` does, and has done so in a moment.
        fcntl.flock(fd, fcntl.LOCK_UN)
        time.sleep(random.uniform(0.0, 0.002))  # of two that try, one is first
    try:
        os.ftruncate(fd, 1)  # not to 0: what is written takes the room of what was there, which there may be no more of
        os.pwrite(fd, about, 0)
    except OSError as error:
        os.close(fd)
        raise private.refusal(path, error) from error
    return Held(fd)


def holder(path: Path) -> Holder | None:
    """Who holds a file now; named "" with the number 0 when that cannot be read. Raises ConfigError."""
    try:
        fd = private.open_file(path, os.O_RDONLY)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        deadline_s = time.monotonic() + LOOK_S
        while not _locked(fd, fcntl.LOCK_SH):
            who = Who.of(os.pread(fd, 4096, 0))
            if who is not None:
                return Holder(who.name, who.pid)
            if time.monotonic() > deadline_s:
                return Holder("", 0)
            time.sleep(0.001)  # it was taken this very moment: its holder is about to write who it is
        return None
    finally:
        os.close(fd)


def _locked(fd: int, kind: int) -> bool:
    """Lock a file, if that can be had at once."""
    try:
        fcntl.flock(fd, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class RunDir:
    """One robot's folder. Nothing is made until something is written."""

    def __init__(self, robot: str, root: Path | None = None) -> None:
        self.robot = robot
        self.root = root or default_run_dir()
        self.path = self.root / robot
        self.profile_file = self.path / "profile.json"
        elsewhere = os.environ.get(LOG_DIR)
        self._log_variable = LOG_DIR if elsewhere else private.RUN_DIR
        self.logs = Path(elsewhere) / robot if elsewhere else self.path / "logs"

    def make(self) -> None:
        """Make the folders. Raises ConfigError for those that cannot be, or are not this user's alone."""
        with private.directory(self.path, make=True):
            pass
        with suppress(private.FullError), self._log_folder(make=True):
            pass

    # --- who runs ---------------------------------------------------------------------------------

    def hold_supervisor(self, profile: str) -> Held:
        """Raises RefusedError when the robot is up already."""
        held = hold(self.path / "supervisor", profile)
        if held is None:
            by = self.supervisor()
            raise RefusedError(
                f"{self.robot} is up already{f' (profile {by.name}, pid {by.pid})' if by else ''}; "
                f"`cocoro down --robot {self.robot}` stops it"
            )
        return held

    def supervisor(self) -> Holder | None:
        """Named after its profile."""
        return holder(self.path / "supervisor")

    def claim(self, process: str, services: Iterable[str]) -> list[Held]:
        """Be these services, alone on this machine. Raises RefusedError when a process is one of them already."""
        held: list[Held] = []
        for service in sorted(services):  # always in one order: of two that start at once, one gets all
            claim = hold(self.path / "claims" / service, process)
            if claim is None:
                by = holder(self.path / "claims" / service)
                for other in held:
                    other.release()
                article = "an" if service[0] in "aeiou" else "a"
                raise RefusedError(
                    f"{self.robot} has {article} {service} already{f' ({by.name}, pid {by.pid})' if by else ''}: "
                    f"stop that one first"
                )
            held.append(claim)
        return held

    def claimant(self, service: str) -> Holder | None:
        """The process of this machine that is a service now."""
        return holder(self.path / "claims" / service)

    def claimant_pid(self, service: str) -> int | None:
        """The number of that process, as `cocoro.contact.Contact` asks for it; 0 when it cannot be read."""
        by = self.claimant(service)
        return None if by is None else by.pid

    def claims(self) -> dict[str, Holder]:
        """Each service that a process of this machine is, and which process that is."""
        folder = self.path / "claims"
        try:
            with private.directory(folder) as fd:
                names = sorted(os.listdir(fd))  # noqa: PTH208 # by descriptor
        except FileNotFoundError:
            return {}
        found = ((name, self.claimant(name)) for name in names)
        return {service: by for service, by in found if by is not None and by.pid}

    # --- the mesh ---------------------------------------------------------------------------------

    def join_as(self, name: str, mesh: Mesh | None = None, *, frames: bool = False) -> ZenohConfig:
        """How a process called `name` gets into the mesh that a profile tells of (the last start's by default).
        `frames`: it publishes or reads them, and would have them in shared memory."""
        if mesh is None:
            mesh = msgspec.convert(self.resolved().get("mesh", {}), Mesh)
        if not mesh.listen and not mesh.connect:
            ours = default(self.robot, name, self.root)
            return replace(
                ours, lease_s=mesh.lease_s, patience_s=mesh.patience_s, shared_memory=frames, options=mesh.options
            )
        fields = msgspec.structs.asdict(mesh)
        return ZenohConfig(name=name, shared_memory=frames, **fields)

    def resolved(self) -> dict[str, Any]:
        """The profile of the last start, as data; empty when there was none, or it is damaged. Raises ConfigError."""
        try:
            data = json.loads(private.read(self.profile_file, PROFILE_BYTES))
        except (FileNotFoundError, ValueError, RecursionError):
            return {}
        return data if isinstance(data, dict) else {}

    def remember(self, profile: bytes) -> None:
        """Write the profile of this start, for those that are started and for those that ask. Raises ConfigError,
        FullError."""
        private.write(self.profile_file, profile)

    @property
    def populated(self) -> bool:
        """Whether any process of this machine is in the robot's mesh."""
        return self.supervisor() is not None or bool(members(self.path))

    # --- logs -------------------------------------------------------------------------------------

    def log(self, process: str) -> Path:
        return self.logs / f"{process}.log"

    def new_log(self, process: str) -> IO[bytes]:
        """A new file for what a process writes; the last start's is set aside, and the oldest forgotten. Raises
        ConfigError, FullError: who runs can run without."""
        log = self.log(process)
        files = [log, *(self.logs / f"{process}.log.{n}" for n in range(1, KEPT_LOGS + 1))]
        with self._log_folder(make=True) as fd:
            try:
                for newer, older in reversed(list(pairwise(files))):
                    with suppress(FileNotFoundError):
                        os.replace(newer.name, older.name, src_dir_fd=fd, dst_dir_fd=fd)
            except OSError as error:
                raise private.refusal(log, error, self._log_variable) from error
        flags = os.O_CREAT | os.O_WRONLY | os.O_TRUNC | os.O_APPEND
        return os.fdopen(private.open_file(log, flags, mode=0o644, variable=self._log_variable), "wb", buffering=0)

    def open_log(self, process: str) -> IO[bytes]:
        """What a process has written since its last start, to be read. Raises FileNotFoundError, ConfigError."""
        return os.fdopen(private.open_file(self.log(process), os.O_RDONLY, variable=self._log_variable), "rb")

    def _log_folder(self, make: bool) -> AbstractContextManager[int]:
        mode = 0o700 if self._log_variable == private.RUN_DIR else 0o755
        return private.directory(self.logs, make=make, mode=mode, variable=self._log_variable)


def robots(root: Path | None = None) -> list[RunDir]:
    """This user's robots of which something runs on this machine. Raises ConfigError for a place that is not to be
    trusted."""
    return [run_dir for run_dir in folders(root) if run_dir.populated]


def folders(root: Path | None = None) -> list[RunDir]:
    """The robots of which this user has a folder, running or not. Raises ConfigError as `robots` does."""
    root = root or default_run_dir()
    try:
        with private.directory(root, own=False) as fd, os.scandir(fd) as entries:
            ours = [e.name for e in entries if e.is_dir(follow_symlinks=False)]
            ours = [name for name in ours if os.stat(name, dir_fd=fd).st_uid == os.geteuid()]
    except FileNotFoundError:
        return []
    return [RunDir(name, root) for name in sorted(ours)]


class Target:
    """A process to signal: the one that held a file when this was made, or nobody."""

    def __init__(self, path: Path) -> None:
        self.pid: int | None = None
        self._fd: int | None = None
        by = holder(path)
        if by is None or not by.pid:
            return
        with suppress(ProcessLookupError):
            self._fd = os.pidfd_open(by.pid)
            if holder(path) == by:  # it still holds the file, so the number is still its own
                self.pid = by.pid
            else:
                self.close()

    def signal(self, number: signal.Signals) -> None:
        if self._fd is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._fd, number)

    def wait(self, timeout_s: float) -> bool:
        """Whether it has ended; waits for that."""
        if self._fd is None:
            return True
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000))

    def close(self) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)


def targets(run_dir: RunDir) -> Iterator[Target]:
    """What still holds a claim, one target a process."""
    seen: set[int] = set()
    for service, by in run_dir.claims().items():
        if by.pid not in seen:
            seen.add(by.pid)
            yield Target(run_dir.path / "claims" / service)
