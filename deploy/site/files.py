"""Files of a site that outlive a loss of power, and folders that are put in place in one step.

A file is written under another name, synced and renamed. A folder, whose files belong together, is written as a draft
and takes the place of the former one by one system call (renameat2 with RENAME_EXCHANGE). One who opened the folder
before finds the former files in it or none, one who opens it later the new ones: nobody sees files of both. Where the
file system cannot exchange (some network file systems) the former folder is renamed first: for a moment there is none.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from cocoro import private
from cocoro.errors import ConfigError, RefusedError
from deploy.site.place import SITE

PRIVATE, PUBLIC = 0o600, 0o644
"""Modes of files."""
LIMIT_BYTES = 4_000_000
"""A longer file is damaged."""
_EXCHANGE = 2  # RENAME_EXCHANGE of linux/fs.h
_CANNOT = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
_NEW = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC


@contextmanager
def locked(site: Path, *, make: bool = False) -> Iterator[int]:
    """Holds the site's folder for one command that changes it, and yields its descriptor. Raises RefusedError while
    another command does, ConfigError when the folder is missing or not safe."""
    with opened(site, own=False, make=make, mode=0o755) as fd:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RefusedError(f"another `cocoro pki` changes {site} now: try again when it is done") from None
        yield fd


@contextmanager
def opened(path: Path, *, own: bool = True, make: bool = False, mode: int = 0o700) -> Iterator[int]:
    """A safe folder's descriptor (see `cocoro.private`). Raises ConfigError when it is missing or not safe."""
    try:
        with private.directory(path, make=make, own=own, mode=mode, variable=SITE) as fd:
            yield fd
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such folder; choose another by {SITE} or --site") from None


def replace_file(folder: Path, fd: int, name: str, data: bytes) -> None:
    """Replaces a public file of a folder with the descriptor `fd`. Raises ConfigError, FullError."""
    draft = f".{name}.new"
    try:
        _remove(fd, draft)
        _write(fd, draft, data, PUBLIC)
        os.replace(draft, name, src_dir_fd=fd, dst_dir_fd=fd)
        os.fsync(fd)
    except OSError as error:
        with suppress(OSError):
            _remove(fd, draft)
        raise private.refusal(folder / name, error, SITE) from error


class Draft:
    """A folder of this user alone that `put` brings into place. Raises ConfigError, FullError."""

    def __init__(self, parent: Path, fd: int, name: str) -> None:
        """`parent` is the folder that will hold it, `fd` its descriptor. A draft that an interrupted command left is
        removed: nobody has got its key."""
        self.path = parent / name
        self._fd, self._name, self._draft = fd, name, f".{name}.new"

    def write(self, files: Mapping[str, tuple[bytes, int]]) -> None:
        """Writes the files, each with its content and mode."""
        with self._failing():
            _remove(self._fd, self._draft)
            os.mkdir(self._draft, 0o700, dir_fd=self._fd)
            inside = os.open(self._draft, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=self._fd)
            try:
                for name, (data, mode) in files.items():
                    _write(inside, name, data, mode)
                os.fsync(inside)
            finally:
                os.close(inside)

    def put(self) -> None:
        """Puts the folder in place and removes the one that stood there."""
        with self._failing():
            try:
                _exchange(self._fd, self._draft, self._name)
            except FileNotFoundError:
                os.rename(self._draft, self._name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
            os.fsync(self._fd)
        with suppress(OSError):  # the next draft removes it
            _remove(self._fd, self._draft)

    def drop(self) -> None:
        with suppress(OSError):
            _remove(self._fd, self._draft)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.drop()
            raise private.refusal(self.path, error, SITE) from error


def read_file(folder: Path, fd: int, name: str, *, secret: bool = False) -> bytes:
    """The content of a file in a folder with the descriptor `fd`; `secret`: nobody else may read it.

    Raises FileNotFoundError when it is missing, ConfigError for what is no regular file, belongs to another user, can
    be changed or, if it is secret, read by others, or is too long.
    """
    path = folder / name
    try:
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY, dir_fd=fd)
    except FileNotFoundError:
        raise
    except OSError as error:
        what = "it is a link: put the file itself there" if error.errno == errno.ELOOP else error.strerror
        raise ConfigError(f"{path}: {what}") from error
    try:
        _check(path, os.fstat(file), secret)
        data = b"".join(iter(lambda: os.read(file, 1 << 16), b""))
    except OSError as error:
        raise private.refusal(path, error, SITE) from error
    finally:
        os.close(file)
    return data


def _check(path: Path, held: os.stat_result, secret: bool) -> None:
    """Raises ConfigError for a file that `read_file` must not read."""
    if not stat.S_ISREG(held.st_mode):
        raise ConfigError(f"{path}: it is not a regular file")
    if held.st_uid != os.geteuid() and (secret or held.st_uid != 0):
        raise ConfigError(f"{path}: it belongs to another user: {_advice('chown', '$USER', path)}")
    if secret and held.st_mode & 0o077:
        raise ConfigError(
            f"{path}: others may read this private key: {_advice('chmod', '600', path)}; if one of them may have, "
            f"revoke its certificate and issue another"
        )
    if held.st_mode & 0o022:
        raise ConfigError(f"{path}: others may change it: {_advice('chmod', '644', path)}")
    if held.st_size > LIMIT_BYTES:
        raise ConfigError(f"{path}: it is too long for what it should be: copy it again")


def remove_folder(folder: Path) -> None:
    """Removes a folder of credentials, if it is there. Raises ConfigError."""
    if not folder.parent.exists():
        return
    with opened(folder.parent) as fd:
        try:
            _remove(fd, folder.name)
        except OSError as error:
            raise private.refusal(folder, error, SITE) from error


def must_be_private(folder: Path, fd: int) -> None:
    """Raises ConfigError when others may look into a folder with the descriptor `fd`."""
    if os.fstat(fd).st_mode & 0o077:
        raise ConfigError(f"{folder}: others may look into this folder: {_advice('chmod', '700', folder)}")


def _advice(program: str, how: str, path: Path) -> str:
    from shlex import quote

    return f"{program} {how} {quote(str(path))}"


def _write(fd: int, name: str, data: bytes, mode: int) -> None:
    with os.fdopen(os.open(name, _NEW, PRIVATE, dir_fd=fd), "wb") as file:
        file.write(data)
        file.flush()
        os.fchmod(file.fileno(), mode)
        os.fsync(file.fileno())


def _remove(fd: int, name: str) -> None:
    """Removes a file, a link or a folder, if it is there."""
    try:
        if stat.S_ISDIR(os.stat(name, dir_fd=fd, follow_symlinks=False).st_mode):
            shutil.rmtree(name, dir_fd=fd)
        else:
            os.unlink(name, dir_fd=fd)
    except FileNotFoundError:
        pass


def _exchange(fd: int, draft: str, name: str) -> None:
    """Exchanges two entries of a folder; afterwards the former `name` is called `draft`. Raises FileNotFoundError when
    there is no `name`."""
    try:
        _rename_exchange(fd, draft, name)
    except OSError as error:
        if error.errno not in _CANNOT:
            raise
        aside = f"{draft}.former"
        _remove(fd, aside)
        os.rename(name, aside, src_dir_fd=fd, dst_dir_fd=fd)
        try:
            os.rename(draft, name, src_dir_fd=fd, dst_dir_fd=fd)
        except BaseException:
            os.rename(aside, name, src_dir_fd=fd, dst_dir_fd=fd)
            raise
        os.rename(aside, draft, src_dir_fd=fd, dst_dir_fd=fd)


def _rename_exchange(fd: int, one: str, other: str) -> None:
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:  # a C library older than the system call
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    if call(fd, os.fsencode(one), fd, os.fsencode(other), _EXCHANGE) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), one)
