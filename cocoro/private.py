"""Directories and files that are this user's alone, in places that other users of the machine share (/tmp, /run).

Another user can put a link or a directory of his own where ours is to be. So every path is walked from the root by
directory descriptors, nothing is made or written before all directories on the way have been looked at, and what is
refused has not been touched:

- a directory on the way belongs to root or to this user, and others may not write to it, unless it keeps what is in it
  from being replaced (the sticky bit, as /tmp has it);
- a link on the way is followed only when it belongs to root or to this user and nobody else may write beside it;
- the last directory is no link, belongs to this user, and nobody else may write to it; a file in it is a regular file
  of this user's, and is never opened through a link.

Root is a user like any other here: it refuses what is not its own. Who operates another user's robot becomes that user
(`sudo -u USER`), and does not reach into his directory as root.
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
"""Environment variable with the place of the run directories."""
LINKS = 40
"""As many links on one way are followed; the kernel's own limit."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
_WALK = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class FullError(ConfigError):
    """Nothing more can be written there: no space, no inodes, no quota, or mounted for reading alone."""


def full(error: OSError) -> bool:
    """Whether it says that a place takes no more."""
    return error.errno in FULL


@contextmanager
def directory(
    path: Path, *, make: bool = False, own: bool = True, mode: int = 0o700, variable: str = RUN_DIR
) -> Iterator[int]:
    """Gives the descriptor of a directory that is safe to use. With `make`, it and those above are made where they are
    missing. With `own=False`, it need not be this user's alone, only one on the way to such a one.

    Raises FileNotFoundError when there is none and none is to be made, ConfigError for one that is not to be trusted
    or cannot be had (`variable` says how to choose another), FullError where none can be made for want of space.
    """
    fd = _open_directory(path, make, own, mode, variable)
    try:
        yield fd
    finally:
        os.close(fd)


def open_file(path: Path, flags: int, *, mode: int = 0o600, make: bool = False, variable: str = RUN_DIR) -> int:
    """The descriptor of a regular file of this user's in a directory of this user's alone; `flags` as of `os.open`.
    With `make`, directories that are missing are made (the file with os.O_CREAT).

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
            raise _refusal(path, "it is no regular file", variable)
        if found.st_uid != os.geteuid():
            raise _refusal(path, _belongs(found.st_uid), variable)
        if flags & os.O_TRUNC:
            os.ftruncate(fd, 0)
    except BaseException:
        os.close(fd)
        raise
    return fd


def write(path: Path, data: bytes) -> None:
    """Write a whole file: whoever reads it finds the old content or the new. Raises ConfigError, FullError."""
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
    """What is in a file, at most so much. Raises FileNotFoundError when it is missing, ConfigError as `open_file`."""
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
    with suppress(FileExistsError):  # somebody makes it at the same time
        os.mkdir(name, mode, dir_fd=fd)
    return os.open(name, _WALK, dir_fd=fd)


def _link(fd: int, name: str) -> tuple[Path, int] | None:
    """Where a link leads, and whose it is; None for what is no link."""
    try:
        return Path(os.readlink(name, dir_fd=fd)), os.stat(name, dir_fd=fd, follow_symlinks=False).st_uid
    except OSError:
        return None


def _trusted() -> tuple[int, int]:
    return 0, os.geteuid()


def _writable(found: os.stat_result) -> bool:
    """Whether others may put something there."""
    return bool(found.st_mode & 0o002)


def _distrust(found: os.stat_result, last: bool) -> str | None:
    """Why a directory is not to be used; the last one of a way must be this user's alone."""
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
    """What to raise for a file or directory that cannot be had."""
    return _refusal(path, error.strerror, variable, error)


def _refusal(path: Path, what: str | None, variable: str, error: OSError | None = None) -> ConfigError:
    place = f"run directory {path}" if variable == RUN_DIR else str(path)
    if error is not None and full(error):
        return FullError(f"{place}: {what}; make room there, or choose another by {variable}")
    return ConfigError(f"{place}: {what}; put that right, or choose another by {variable}")
