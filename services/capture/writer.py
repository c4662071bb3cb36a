"""A run's captures: one MCAP file after another, each whole in itself, without a message lost in between."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from mcap.records import Channel, Schema

from cocoro.capture.conventions import CaptureError
from cocoro.capture.types import TypeSchema
from cocoro.clock import NS
from cocoro.messages import DisturbedFile
from services.capture.file import CaptureFile, Packer
from services.capture.keys import KeyInfo, PreparedMessage, QueuedMessage

MB = 1_000_000
LOOK_S = 1.0
"""How often it is looked whether the file is still where it was made."""
KEPT_DISTURBED = 20


ChannelName = str | tuple[str, int]
"""A channel of a writer: the key, or the key and a number where the key may have several."""


@dataclass(frozen=True)
class Limits:
    """When a file is closed and the next one begun, and when to stop."""

    file_bytes: float = float("inf")
    file_s: float = float("inf")
    min_free_bytes: int = 0
    """Recording stops when the disk has less room left, so that the robot has some."""


def sync_and_close(fd: int) -> None:
    try:
        os.fdatasync(fd)
    finally:
        os.close(fd)


class Missing(NamedTuple):
    """By key: what did not get into the captures."""

    dropped: Mapping[str, int]
    lost: Mapping[str, int]


class CaptureWriter:
    """Takes entries in order of their log times. Raises CaptureError when the disk does not take them; what was
    written until then is closed as well as can be, and the writer is of no more use."""

    def __init__(
        self,
        place: Callable[[int], Path],
        packer: Packer,
        limits: Limits,
        info: Callable[[str, bytes], KeyInfo],
        missing: Callable[[], Missing] = lambda: Missing({}, {}),
        release: Callable[[int], None] = sync_and_close,
        prepare: Callable[[QueuedMessage], PreparedMessage] | None = None,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`place(n)` is the nth file's path, from 1 on; `info(key, payload)` says what to write of a key; `release`
        gets the descriptor of a file that is whole; `prepare` may put something else in an entry's place."""
        self._place = place
        self._packer = packer
        self._limits = limits
        self._info = info
        self._missing = missing
        self._release = release
        self._prepare = prepare
        self._monotonic_s = monotonic_s
        self._look_at_s = 0.0
        self._metadata: dict[str, dict[str, str]] = {}
        self._infos: dict[ChannelName, KeyInfo] = {}
        self._channels: dict[ChannelName, int] = {}
        self._schemas: dict[TypeSchema, int] = {}
        """The numbers of channels and schemas in this file."""
        self._number = 0
        self._first_ns: int | None = None
        self._closed_bytes = 0
        self._closed_raw_bytes = 0
        self._ended: CaptureFile | None = None
        """The last one that is closed."""
        self.messages = 0
        """Written, but for those of files that were removed while they were being written."""
        self.removed = 0
        """Those of such files."""
        self.disturbed: tuple[DisturbedFile, ...] = ()
        """The newest of the files that were moved or removed while they were being written."""
        self.file = self._open()
        self.where = str(self.file.path)
        """Where the file is that is being written, or was written last; '' when it is not on the disk any more."""

    @property
    def size_bytes(self) -> int:
        return self._closed_bytes + (0 if self._ended is self.file else self.file.size_bytes)

    @property
    def raw_bytes(self) -> int:
        return self._closed_raw_bytes + (0 if self._ended is self.file else self.file.raw_bytes)

    def put(self, entry: QueuedMessage) -> None:
        if self._first_ns is None:
            self._first_ns = entry.log_ns
        elif (
            self.file.size_bytes >= self._limits.file_bytes or entry.log_ns - self._first_ns >= self._limits.file_s * NS
        ):
            self._rotate()
            self._first_ns = entry.log_ns
        schema = None
        if self._prepare is not None:
            entry, schema = self._prepare(entry)
        try:
            name: ChannelName = entry.key if entry.channel is None else (entry.key, entry.channel)
            channel = self._channels.get(name) or self._channel(name, entry, schema)
            self.file.add(channel, entry.sequence, entry.log_ns, entry.publish_ns, entry.payload)
        except OSError as error:
            raise self._failed(error) from error
        self.messages += 1

    def _channel(self, name: ChannelName, entry: QueuedMessage, schema: TypeSchema | None) -> int:
        """Make a key known to the file."""
        info = self._infos.get(name)
        if info is None:
            info = entry.info or self._info(entry.key, entry.payload)
            info = self._infos[name] = info if schema is None else info._replace(schema=schema)
        schema_id = 0
        if info.schema is not None:
            schema_id = self._schemas.setdefault(info.schema, len(self._schemas) + 1)
            self.file.schema(Schema(schema_id, info.schema.data, info.schema.encoding, info.schema.name))
        channel = self._channels[name] = len(self._channels) + 1
        self.file.channel(Channel(channel, entry.key, info.encoding, info.metadata, schema_id))
        return channel

    def flush(self) -> None:
        """Give everything to the system; and see whether the file is still where it was made, and whether the disk has
        room for more."""
        try:
            self.file.flush()
            self._look()
            room = os.fstatvfs(self.file.fileno())
        except OSError as error:
            raise self._failed(error) from error
        if room.f_bavail * room.f_frsize < self._limits.min_free_bytes:
            self.close()
            raise CaptureError(
                f"{self.file.path.parent}: less than {self._limits.min_free_bytes / MB:.0f} MB are free; "
                f"make room, or write elsewhere"
            )

    def remember(self, name: str, entries: Mapping[str, str]) -> None:
        """Metadata for this file and those that follow. What is remembered already is not written again."""
        if self._metadata.get(name) == entries:
            return
        self._metadata[name] = dict(entries)
        try:
            self.file.metadata(name, entries)
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Make the file whole."""
        try:
            self._finish(self.file)
        except OSError as error:
            self._abandon(self.file)
            raise _told(error, self.file.path) from error

    def _look(self) -> None:
        """Go on in a new file when somebody has moved or removed this one."""
        now_s = self._monotonic_s()
        if now_s < self._look_at_s:
            return
        self._look_at_s = now_s + LOOK_S
        if locate(self.file.path, self.file.fileno()).state != "there":
            self._rotate()
            self._first_ns = None

    def _open(self) -> CaptureFile:
        self._number += 1
        path = self._place(self._number)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                file = CaptureFile(path, self._packer)
            except FileExistsError:
                if self._place(self._number + 1) == path:
                    raise
                return self._open()  # another recorder, begun in the same moment, has taken the name
            try:
                for name, entries in self._metadata.items():
                    file.metadata(name, entries)
                _sync_folder(path.parent)
            except OSError:
                file.abandon()
                raise
        except OSError as error:
            raise _told(error, path) from error
        return file

    def _rotate(self) -> None:
        """The next file stands before the last one ends."""
        before = self.file
        try:
            after = self._open()
        except CaptureError:
            self.close()
            raise
        self.file, self._channels, self._schemas = after, {}, {}
        try:
            self._finish(before)
        except OSError as error:
            self._abandon(before)
            raise self._failed(error) from error
        self.where = str(after.path)

    def _finish(self, file: CaptureFile) -> None:
        file.flush()
        file.tally(*self._missing())
        fd = file.finish()
        self._account(file)
        self._release(fd)

    def _abandon(self, file: CaptureFile) -> None:
        self._account(file)
        file.abandon()

    def _account(self, file: CaptureFile) -> None:
        """See, once, what has become of a file that gets no more, before it is closed."""
        if self._ended is file:
            return
        found = locate(file.path, file.fileno())
        self._ended, self.where = file, found.path
        if found.state == "removed":
            lost = sum(tally.messages for tally in file.tallies.values())
            self.messages -= lost
            self.removed += lost
        else:
            lost = 0
            self._closed_bytes += file.size_bytes
            self._closed_raw_bytes += file.raw_bytes
        if found.state != "there":
            disturbed = DisturbedFile(file=str(file.path), became=found.state, now=found.path, lost=lost)
            self.disturbed = (*self.disturbed, disturbed)[-KEPT_DISTURBED:]

    def _failed(self, error: OSError) -> CaptureError:
        """Leave the file as good as it can be."""
        try:
            self._finish(self.file)
        except OSError:
            self._abandon(self.file)
        return _told(error, self.file.path)


def _told(error: OSError, path: Path) -> CaptureError:
    return CaptureError(f"{path}: {error.strerror or error}")


def _sync_folder(folder: Path) -> None:
    """A new file's name is lost with the power as its bytes are."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


class FileLocation(NamedTuple):
    state: Literal["there", "moved", "removed"]
    path: str
    """Where it is; '' when it was removed, or when the system does not tell where it was moved."""


def locate(path: Path, fd: int) -> FileLocation:
    """Whether the file that is open as `fd` still has its path. A move to another disk is a copy and a removal, and so
    it looks here: the copy may lack what was written last."""
    mine = os.fstat(fd)
    try:
        if os.path.samestat(path.stat(), mine):
            return FileLocation("there", str(path))
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError:  # a folder that must not be looked into, a disk that does not answer: nothing is known
        return FileLocation("there", str(path))
    now = _name(fd, mine)
    # A network file system keeps what is removed under such a name for as long as it is open.
    if mine.st_nlink == 0 or Path(now).name.startswith(".nfs"):
        return FileLocation("removed", "")
    return FileLocation("moved", now)


def describe_disturbance(file: DisturbedFile) -> str:
    """A line for people."""
    if file.became == "removed":
        return (
            f"{file.file} was removed (or moved to another disk) while it was recorded: {file.lost} messages are lost"
        )
    where = f"to {file.now}" if file.now else "elsewhere"
    return f"{file.file} was moved {where} while it was recorded"


def _name(fd: int, mine: os.stat_result) -> str:
    """The name that the system knows a descriptor's file by; '' when that is not the file's name any more."""
    try:
        name = Path(f"/proc/self/fd/{fd}").readlink()
        return str(name) if os.path.samestat(name.stat(), mine) else ""
    except OSError:
        return ""
