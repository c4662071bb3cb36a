"""The run directory: one folder per robot with the state of its processes on this machine.

    <run>/<robot>/profile.json     the resolved profile of the last start
                  clock            the robot's time (see deploy.robot_time)
                  survey.sock      where the supervisor answers `cocoro status` (see deploy.survey)
                  supervisor       held by the supervisor (see cocoro.held_file)
                  claims/<service> held by the process that is that service
                  logs/            one file per process, of the last starts (or in $COCORO_LOG_DIR/<robot>)
                  (and the mesh's register, see cocoro.bus.register)

The folders and the files in them are this user's alone (see `cocoro.private`). Others are refused with a ConfigError;
when the disk is full, what must be written raises FullError.

`cocoro stop` and `cocoro status` look here first, so what takes long to import is imported where it is used.
"""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from itertools import pairwise
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from cocoro import private
from cocoro.errors import RefusedError
from cocoro.held_file import HeldFile, Holder, hold, holder
from cocoro.private import default_run_dir

if TYPE_CHECKING:
    from cocoro.bus.endpoints import ZenohConfig
    from deploy.mesh_table import Mesh

PROFILE_BYTES = 1024 * 1024
"""Upper bound of a profile's size."""
KEPT_LOGS = 5
"""Logs of earlier starts that are kept, per process."""
START = "start one with `cocoro up sim`"
"""What to do where no robot is up."""


class RunDir:
    """One robot's folder. It is made when something is first written."""

    def __init__(self, robot: str, root: Path | None = None) -> None:
        self.robot = robot
        self.root = root or default_run_dir()
        self.path = self.root / robot
        self.profile_file = self.path / "profile.json"
        self.logs, self._log_variable = private.log_folder(robot, self.path)

    def make(self) -> None:
        """Makes the folders. Raises ConfigError for one that cannot be made or is not this user's alone."""
        with private.directory(self.path, make=True):
            pass
        with suppress(private.FullError), self._log_folder(make=True):
            pass

    # --- who runs ---------------------------------------------------------------------------------

    def hold_supervisor(self, profile: str) -> HeldFile:
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
        """The supervisor, with its profile's name as the holder's name."""
        return holder(self.path / "supervisor")

    def claim(self, process: str, services: Iterable[str]) -> list[HeldFile]:
        """Makes this process these services on this machine. Raises RefusedError when another process is one of
        them."""
        held: list[HeldFile] = []
        for service in sorted(services):  # in a fixed order, so that of two processes that start together one gets all
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
        """The process of this machine that is a service now; None when there is none."""
        return holder(self.path / "claims" / service)

    def claimant_pid(self, service: str) -> int | None:
        """The number of that process, for `deploy.contact.ProcessContact`; 0 when it cannot be read. Raises
        FileNotFoundError when there is no file to claim it by: this process may never have been here, or its file was
        removed while it lives."""
        by = self.claimant(service)
        if by is None:
            (self.path / "claims" / service).stat()
            return None
        return by.pid

    def claims(self) -> dict[str, Holder]:
        """The process behind each service of this machine, by service."""
        folder = self.path / "claims"
        try:
            with private.directory(folder) as fd:
                names = sorted(os.listdir(fd))  # noqa: PTH208 # by descriptor
        except FileNotFoundError:
            return {}
        found = ((name, self.claimant(name)) for name in names)
        return {service: by for service, by in found if by is not None and by.known}

    # --- the mesh ---------------------------------------------------------------------------------

    def join_as(self, name: str, mesh: Mesh | None = None, *, frames: bool = False) -> ZenohConfig:
        """Configure a process called `name` to join the mesh of a profile (by default the last start's). `frames`: it
        publishes or reads frames, so it asks for shared memory."""
        from dataclasses import replace

        import msgspec

        from cocoro.bus.endpoints import default
        from deploy.mesh_table import Mesh

        if mesh is None:
            mesh = msgspec.convert(self.resolved().get("mesh", {}), Mesh)
        ours = default(self.robot, name, self.root)
        return replace(ours, shared_memory=frames, **msgspec.structs.asdict(mesh))

    def resolved(self) -> dict[str, Any]:
        """The profile of the last start, as data; empty when there is none or it is damaged. Raises ConfigError."""
        import json

        try:
            data = json.loads(private.read(self.profile_file, PROFILE_BYTES))
        except (FileNotFoundError, ValueError, RecursionError):
            return {}
        return data if isinstance(data, dict) else {}

    def remember(self, profile: bytes) -> None:
        """Writes the profile of this start, for the processes that it starts and for commands. Raises ConfigError,
        FullError."""
        private.write(self.profile_file, profile)

    @property
    def survey_socket(self) -> Path:
        """Where the supervisor answers `cocoro status`."""
        return self.path / "survey.sock"

    @property
    def populated(self) -> bool:
        """Whether a process of this machine is in the robot's mesh."""
        if self.supervisor() is not None:
            return True
        from cocoro.bus.register import members

        return bool(members(self.path))

    # --- logs -------------------------------------------------------------------------------------

    def log(self, process: str) -> Path:
        return self.logs / f"{process}.log"

    def new_log(self, process: str) -> IO[bytes]:
        """A new log file for a process; earlier logs are rotated, and the oldest is removed. Raises ConfigError,
        FullError; a process can run without a log."""
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
        """Opens a process's log since its last start for reading. Raises FileNotFoundError, ConfigError."""
        return os.fdopen(private.open_file(self.log(process), os.O_RDONLY, variable=self._log_variable), "rb")

    def _log_folder(self, make: bool) -> AbstractContextManager[int]:
        mode = 0o700 if self._log_variable == private.RUN_DIR else 0o755
        return private.directory(self.logs, make=make, mode=mode, variable=self._log_variable)


def robots(root: Path | None = None) -> list[RunDir]:
    """List this user's robots that have a process on this machine. Raises ConfigError for a run directory that is not
    to be trusted."""
    return [run_dir for run_dir in folders(root) if run_dir.populated]


def folders(root: Path | None = None) -> list[RunDir]:
    """List this user's robots that have a folder, running or not. Raises ConfigError as `robots` does."""
    root = root or default_run_dir()
    try:
        with private.directory(root, own=False) as fd, os.scandir(fd) as entries:
            ours = [e.name for e in entries if e.is_dir(follow_symlinks=False)]
            ours = [name for name in ours if os.stat(name, dir_fd=fd).st_uid == os.geteuid()]
    except FileNotFoundError:
        return []
    return [RunDir(name, root) for name in sorted(ours)]


class Target:
    """A process to signal: the one that held a file when this was made, or none (`pid` None)."""

    def __init__(self, path: Path) -> None:
        self.pid: int | None = None
        self._fd: int | None = None
        by = holder(path)
        if by is None or not by.known:
            return
        with suppress(ProcessLookupError):
            self._fd = os.pidfd_open(by.pid)
            if holder(path) == by:  # it still holds the file, so the number is still its number
                self.pid = by.pid
            else:
                self.close()

    def signal(self, number: signal.Signals) -> None:
        if self._fd is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._fd, number)

    def wait(self, timeout_s: float) -> bool:
        """Waits for the process to end, for at most `timeout_s`; returns whether it has."""
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
    """The processes that still hold a claim, one target each."""
    seen: set[int] = set()
    for service, by in run_dir.claims().items():
        if by.pid not in seen:
            seen.add(by.pid)
            yield Target(run_dir.path / "claims" / service)
