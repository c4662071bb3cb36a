"""Directories and files that are this user's alone, in places that the machine's users share (/tmp, /run).

Another user could put a link or a directory in place of ours. So every path is walked from the root by directory
descriptors, and nothing is made or written before all directories on the way have been checked:

- A directory on the way belongs to root or this user, and others may not write to it, unless it has the sticky bit,
  which keeps its entries from being replaced (as /tmp has).
- A link on the way is followed only when it belongs to root or this user and no other user may write beside it.
- The last directory is no link, belongs to this user, and no other user may write to it. A file in it is a regular file
  of this user and is never opened through a link.

Root is a user like any other here and is refused other users' directories: to operate another user's robot, become that
user (`sudo -u USER`).
"""

from __future__ import annotations

import errno
import os
import pwd
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cocoro.errors import ConfigError

RUN_DIR = "COCORO_RUN_DIR"
"""Environment variable with the place of the run directory."""
LOG_DIR = "COCORO_LOG_DIR"
"""Environment variable with a place for the logs that outlives the run directory."""
TEMPORARY = "/tmp"
LINKS = 40
"""Links that are followed on one path; the kernel's own limit."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
_WALK = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class FullError(ConfigError):
    """Nothing more can be written: no space, no inodes, no quota, or a read-only file system."""


def full(error: OSError) -> bool:
    """Whether an error means that nothing more can be written (see `FullError`)."""
    return error.errno in FULL


@contextmanager
def directory(
    path: Path, *, make: bool = False, own: bool = True, mode: int = 0o700, variable: str = RUN_DIR
) -> Iterator[int]:
    """Yields the descriptor of a safe directory. With `make`, missing directories are made. With `own=False` the rules
    for directories on the way apply to it instead of those for the last one.

    Raises FileNotFoundError when it is missing, ConfigError when it is not safe or cannot be opened (`variable` is the
    environment variable that chooses another place), FullError when it cannot be made for lack of space.
    """
    fd = _open_directory(path, make, own, mode, variable)
    try:
        yield fd
    finally:
        os.close(fd)


def open_file(path: Path, flags: int, *, mode: int = 0o600, make: bool = False, variable: str = RUN_DIR) -> int:
    """Opens a regular file of this user in a directory that is this user's alone; `flags` as for `os.open`. With
    `make`, missing directories are made. Returns the descriptor.

    Raises FileNotFoundError when it is missing, ConfigError and FullError as `directory` does.
    """
    with directory(path.parent, make=make, variable=variable) as parent_fd:
        wanted = (flags & ~os.O_TRUNC) | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
        try:
            fd = os.open(path.name, wanted, mode, dir_fd=parent_fd)
        except FileNotFoundError:
            raise
        except OSError as error:
            what = "it is a link" if error.errno == errno.ELOOP else error.strerror
            raise _refusal(path, what, variable, error) from error
    try:
        found = os.fstat(fd)
        if not stat.S_ISREG(found.st_mode):
            raise _refusal(path, "it is not a regular file", variable)
        if found.st_uid != os.geteuid():
            raise _refusal(path, _belongs(found.st_uid), variable)
        if flags & os.O_TRUNC:
            os.ftruncate(fd, 0)
    except BaseException:
        os.close(fd)
        raise
    return fd


def write(path: Path, data: bytes) -> None:
    """Replaces a file atomically. Raises ConfigError, FullError."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        fd = open_file(fresh, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, make=True)
        with os.fdopen(fd, "wb") as file:
            file.write(data)
        with directory(path.parent) as fd:
            os.replace(fresh.name, path.name, src_dir_fd=fd, dst_dir_fd=fd)
    except OSError as error:
        with suppress(OSError, ConfigError), directory(path.parent) as fd:
            os.unlink(fresh.name, dir_fd=fd)
        raise refusal(path, error) from error


def read(path: Path, limit_bytes: int) -> bytes:
    """Reads a file, at most `limit_bytes`. Raises FileNotFoundError, ConfigError as `open_file` does."""
    with os.fdopen(open_file(path, os.O_RDONLY), "rb") as file:
        return file.read(limit_bytes)


def _open_directory(path: Path, make: bool, own: bool, mode: int, variable: str) -> int:
    at, waiting, links = Path("/"), list(reversed(path.absolute().parts[1:])), 0
    fd = os.open("/", _WALK)
    try:
        while waiting:
            name = waiting.pop()
            held = os.fstat(fd)
            try:
                below = _step(fd, name, make, mode)
            except FileNotFoundError:
                raise
            except OSError as error:
                link = _link(fd, name)
                if link is None:
                    raise refusal(at / name, error, variable) from error
                links += 1
                target, owner = link
                if (own and not waiting) or _writable(held) or owner not in _trusted() or links > LINKS:
                    raise _refusal(at / name, "it is a link, which is not followed here", variable) from None
                if target.is_absolute():
                    at, below = Path("/"), os.open("/", _WALK)
                else:
                    below = os.dup(fd)
                waiting.extend(reversed([part for part in target.parts if part != "/"]))
            else:
                at = at / name
                fresh = os.fstat(below)
                why = _distrust(fresh, last=own and not waiting)
                if why is not None:
                    os.close(below)
                    raise _refusal(at, why, variable)
            os.close(fd)
            fd = below
        try:
            return os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=fd)
        except OSError as error:
            raise refusal(at, error, variable) from error
    finally:
        os.close(fd)


def _step(fd: int, name: str, make: bool, mode: int) -> int:
    try:
        return os.open(name, _WALK, dir_fd=fd)
    except FileNotFoundError:
        if not make:
            raise
    with suppress(FileExistsError):  # another process makes it at the same time
        os.mkdir(name, mode, dir_fd=fd)
    return os.open(name, _WALK, dir_fd=fd)


def _link(fd: int, name: str) -> tuple[Path, int] | None:
    """The target of a link and its owner; None when it is no link."""
    try:
        return Path(os.readlink(name, dir_fd=fd)), os.stat(name, dir_fd=fd, follow_symlinks=False).st_uid
    except OSError:
        return None


def _trusted() -> tuple[int, int]:
    return 0, os.geteuid()


def _writable(found: os.stat_result) -> bool:
    """Whether every user may write to it."""
    return bool(found.st_mode & 0o002)


def _distrust(found: os.stat_result, last: bool) -> str | None:
    """The reason for which a directory is not safe, or None; the last one of a path must be this user's alone."""
    if found.st_uid not in ((os.geteuid(),) if last else _trusted()):
        return _belongs(found.st_uid)
    if last and found.st_mode & 0o022:
        return "others may write to it, and only this user may"
    if _writable(found) and not found.st_mode & stat.S_ISVTX:
        return "others may replace what is in it, and only this user may"
    return None


def _belongs(uid: int) -> str:
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = f"user {uid}"
    return f"it belongs to {name}: operate that user's robots as that user (sudo -u)"


def refusal(path: Path, error: OSError, variable: str = RUN_DIR) -> ConfigError:
    """The exception for a file or directory that cannot be opened, made or written."""
    return _refusal(path, error.strerror, variable, error)


def _refusal(path: Path, what: str | None, variable: str, error: OSError | None = None) -> ConfigError:
    place = f"run directory {path}" if variable == RUN_DIR else str(path)
    if error is not None and full(error):
        return FullError(f"{place}: {what}; make room there, or choose another by {variable}")
    return ConfigError(f"{place}: {what}; put that right, or choose another by {variable}")


def default_run_dir() -> Path:
    """$COCORO_RUN_DIR, else `cocoro` in $XDG_RUNTIME_DIR, else a directory of this user in the place for temporary
    files. Its content must be this user's alone."""
    if explicit := os.environ.get(RUN_DIR):
        return Path(explicit).absolute()
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "cocoro"
    return Path(_place_for_temporary_files()) / f"cocoro-{os.getuid()}"


def log_folder(robot: str, folder: Path) -> tuple[Path, str]:
    """The folder of a robot's logs, one file for each process, where its run directory is `folder`; and the environment
    variable that says where it is."""
    elsewhere = os.environ.get(LOG_DIR)
    return (Path(elsewhere) / robot, LOG_DIR) if elsewhere else (folder / "logs", RUN_DIR)


def _place_for_temporary_files() -> str:
    """That of `tempfile`, which is slow to import and is asked only where it is not plain."""
    plain = not any(os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    if plain and Path(TEMPORARY).is_dir() and os.access(TEMPORARY, os.W_OK | os.X_OK):
        return TEMPORARY
    import tempfile

    return tempfile.gettempdir()
