"""Writes a run's captures: MCAP files one after another, each complete in itself, with no message lost in between."""

from __future__ import annotations

import os
import stat
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from mcap.records import Channel, Schema

from cocoro.capture.conventions import CaptureError
from cocoro.capture.occasion import Occasion
from cocoro.capture.types import TypeSchema
from cocoro.clock import NS
from cocoro.messages import DisturbedFile
from services.capture.file import CaptureFile
from services.capture.keys import KeyInfo, PreparedMessage, QueuedMessage
from services.capture.occasions import OccasionNews
from services.capture.packing import PackedMessage, Packer

MB = 1_000_000
LOOK_S = 1.0
"""Period of the check whether the file is still at its path."""
KEPT_DISTURBED = 20


ChannelName = str | tuple[str, int]
"""Identifies a channel: the key, or key and number where a key has several channels."""


@dataclass(frozen=True)
class FileLimits:
    """The limits at which the next file is begun, and at which recording stops."""

    file_bytes: float = float("inf")
    file_s: float = float("inf")
    min_free_bytes: int = 0
    """Recording stops when the disk has less room left, to leave some for the robot."""


def sync(fd: int) -> None:
    """Sync a file's content, or the entries of a folder."""
    if stat.S_ISDIR(os.fstat(fd).st_mode):
        os.fsync(fd)
    else:
        os.fdatasync(fd)


def sync_and_close(fd: int) -> None:
    try:
        sync(fd)
    finally:
        os.close(fd)


class Missing(NamedTuple):
    """Messages that are not in the captures, by key."""

    dropped: Mapping[str, int]
    lost: Mapping[str, int]
    left_out: Mapping[str, int] = {}
    """Of this file, by intention, while nothing happened; it is no loss."""


class CaptureWriter:
    """Takes messages in the order of their log times. Raises CaptureError when the disk refuses; the file is then
    closed as completely as possible, and the writer must not be used any more."""

    def __init__(
        self,
        place: Callable[[int], Path],
        packer: Packer,
        limits: FileLimits,
        info: Callable[[str, bytes], KeyInfo],
        missing: Callable[[], Missing] = lambda: Missing({}, {}),
        release: Callable[[int], None] = sync_and_close,
        prepare: Callable[[QueuedMessage], PreparedMessage] | None = None,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`place(n)` is the path of the nth file, from 1 on. `info(key, payload)` gives a new channel's information.
        `release` takes the descriptor of a completed file, or of the folder of a new one, to sync and close it.
        `prepare` may replace each message."""
        self._place = place
        self._packer = packer
        self.limits = limits
        self._info = info
        self._missing = missing
        self._release = release
        self._prepare = prepare
        self._monotonic_s = monotonic_s
        self._look_at_s = 0.0
        self._metadata: dict[str, dict[str, str]] = {}
        self._numbers: dict[ChannelName, int] = {}
        """Numbers of the channels, the same in all files."""
        self._channels: dict[int, tuple[Channel, Schema | None]] = {}
        self._schemas: dict[TypeSchema, int] = {}
        self._declared: set[int] = set()
        """Channels in the current file."""
        self._number = 0
        self._first_ns: int | None = None
        self._closed_bytes = 0
        self._closed_raw_bytes = 0
        self._ended: CaptureFile | None = None
        """The file that was closed last."""
        self.occasion: Occasion | None = None
        """What happens now, for a writer that records that in another way than the rest."""
        self.left_out: Counter[str] = Counter()
        """By key: messages that were left out since the start, by intention."""
        self.free_bytes = 0
        """Room on the disk at the last flush, without what stays free."""
        self.messages = 0
        """Written messages, without those of files that were removed during recording."""
        self.removed = 0
        """Messages in files that were removed during recording."""
        self.disturbed: tuple[DisturbedFile, ...] = ()
        """The newest files that were moved or removed during recording."""
        self.file = self._open()
        self.where = str(self.file.path)
        """Path of the current or last file; '' when it is no longer on the disk."""

    @property
    def size_bytes(self) -> int:
        return self._closed_bytes + (0 if self._ended is self.file else self.file.size_bytes)

    @property
    def raw_bytes(self) -> int:
        return self._closed_raw_bytes + (0 if self._ended is self.file else self.file.raw_bytes)

    def put(self, message: QueuedMessage) -> None:
        self._turn(message.log_ns)
        message, number = self._numbered(message)
        try:
            self._declare(number)
            self.file.add(number, message.sequence, message.log_ns, message.publish_ns, message.payload)
        except OSError as error:
            raise self._failed(error) from error
        self.messages += 1

    def pack(self, message: QueuedMessage) -> PackedMessage:
        """Pack a message for `put_packed`, into this file or a later one.

        Its bytes are a copy. The packer makes room for a message that does not shrink and gives the rest back, and many
        such rests, none of which fits the next message, take as much memory as if nothing had been packed.
        """
        message, number = self._numbered(message)
        packed = self._packer.message(number, message.sequence, message.log_ns, message.publish_ns, message.payload)
        return packed._replace(data=bytes(memoryview(packed.data)))

    def put_packed(self, packed: PackedMessage) -> None:
        self._turn(packed.log_ns)
        try:
            self._declare(packed.channel_id)
            self.file.add_packed(packed)
        except OSError as error:
            raise self._failed(error) from error
        self.messages += 1

    def _turn(self, log_ns: int) -> None:
        """Begin a new file where the current one is large or long enough."""
        if self._first_ns is None:
            self._first_ns = log_ns
        elif self.file.size_bytes >= self.limits.file_bytes or log_ns - self._first_ns >= self.limits.file_s * NS:
            self._rotate()
            self._first_ns = log_ns

    def _numbered(self, message: QueuedMessage) -> tuple[QueuedMessage, int]:
        """The message as it is to be written, and its channel's number."""
        schema = None
        if self._prepare is not None:
            message, schema = self._prepare(message)
        name: ChannelName = message.key if message.channel is None else (message.key, message.channel)
        number = self._numbers.get(name)
        if number is None:
            number = self._numbers[name] = len(self._numbers) + 1
            info = message.info or self._info(message.key, message.payload)
            self._channels[number] = self._channel(number, message.key, info, schema or info.schema)
        return message, number

    def _channel(
        self, number: int, key: str, info: KeyInfo, schema: TypeSchema | None
    ) -> tuple[Channel, Schema | None]:
        if schema is None:
            return Channel(number, key, info.encoding, info.metadata, 0), None
        schema_id = self._schemas.setdefault(schema, len(self._schemas) + 1)
        declared = Schema(schema_id, schema.data, schema.encoding, schema.name)
        return Channel(number, key, info.encoding, info.metadata, schema_id), declared

    def _declare(self, number: int) -> None:
        """Declare a channel in the current file."""
        if number not in self._declared:
            self._declared.add(number)
            channel, schema = self._channels[number]
            if schema is not None:
                self.file.schema(schema)
            self.file.channel(channel)

    def flush(self) -> None:
        """Hand everything to the operating system; check that the file is at its path and the disk has room."""
        try:
            self.file.flush()
            self._look()
            room = os.fstatvfs(self.file.fileno())
        except OSError as error:
            raise self._failed(error) from error
        self.free_bytes = max(room.f_bavail * room.f_frsize - self.limits.min_free_bytes, 0)
        if room.f_bavail * room.f_frsize < self.limits.min_free_bytes:
            self.close()
            raise CaptureError(
                f"{self.file.path.parent}: less than {self.limits.min_free_bytes / MB:.0f} MB are free; "
                f"make room, or write elsewhere"
            )

    def remember(self, name: str, entries: Mapping[str, str]) -> None:
        """Write metadata into this file and all later ones. Unchanged metadata is not written again."""
        if self._metadata.get(name) == entries:
            return
        self._metadata[name] = dict(entries)
        try:
            self.file.metadata(name, entries)
        except OSError as error:
            raise self._failed(error) from error

    @property
    def kept_bytes(self) -> int:
        """Size of the captures in the folder when the file began; 0 when nobody looks after them."""
        return 0

    @property
    def keep_bytes(self) -> int | None:
        """Limit of that; None without one."""
        return None

    @property
    def deleted(self) -> tuple[str, ...]:
        """Names of the captures that made room."""
        return ()

    def forget(self, name: str) -> None:
        """Later files have no metadata of this name."""
        self._metadata.pop(name, None)

    def tell(self, what: OccasionNews, occasion: Occasion) -> None:
        """An occasion began, changed or ended."""

    def rotate(self) -> None:
        """Begin a new file."""
        self._rotate()
        self._first_ns = None

    def close(self) -> None:
        """Complete the file."""
        try:
            self._finish(self.file)
        except OSError as error:
            self._abandon(self.file)
            raise _error(error, self.file.path) from error

    def _look(self) -> None:
        """Begin a new file when the current one was moved or removed."""
        now_s = self._monotonic_s()
        if now_s < self._look_at_s:
            return
        self._look_at_s = now_s + LOOK_S
        if locate(self.file.path, self.file.fileno()).state != "there":
            self.rotate()

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
                return self._open()  # another recorder that began at the same time has this name
            try:
                for name, entries in self._metadata.items():
                    file.metadata(name, entries)
                # Syncs the folder, so that the new file's entry survives a loss of power.
                self._release(os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC))
            except OSError:
                file.abandon()
                raise
        except OSError as error:
            raise _error(error, path) from error
        return file

    def _rotate(self) -> None:
        """Open the next file before the current one is closed, so that no message is lost."""
        before = self.file
        try:
            after = self._open()
        except CaptureError:
            self.close()
            raise
        self.file, self._declared = after, set()
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
        """Find out, once, where a file is before it is closed, and update the counts."""
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
        """Complete the file as far as possible."""
        try:
            self._finish(self.file)
        except OSError:
            self._abandon(self.file)
        return _error(error, self.file.path)


def _error(error: OSError, path: Path) -> CaptureError:
    return CaptureError(f"{path}: {error.strerror or error}")


class FileLocation(NamedTuple):
    state: Literal["there", "moved", "removed"]
    path: str
    """The current path; '' when the file was removed, or the system does not know where it was moved."""


def locate(path: Path, fd: int) -> FileLocation:
    """Whether the open file `fd` is still at its path. A move to another disk is a copy and a removal, and is reported
    as a removal: the copy may lack what was written last."""
    mine = os.fstat(fd)
    try:
        if os.path.samestat(path.stat(), mine):
            return FileLocation("there", str(path))
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError:  # no permission, or the disk does not answer: assume that it is there
        return FileLocation("there", str(path))
    now = _name(fd, mine)
    # A network file system keeps a removed file under such a name while it is open.
    if mine.st_nlink == 0 or Path(now).name.startswith(".nfs"):
        return FileLocation("removed", "")
    return FileLocation("moved", now)


def describe_disturbance(file: DisturbedFile) -> str:
    """One line for an operator."""
    if file.became == "removed":
        return (
            f"{file.file} was removed (or moved to another disk) while it was recorded: {file.lost} messages are lost"
        )
    where = f"to {file.now}" if file.now else "elsewhere"
    return f"{file.file} was moved {where} while it was recorded"


def _name(fd: int, mine: os.stat_result) -> str:
    """The name that the system has for an open descriptor; '' when another file has that name now."""
    try:
        name = Path(f"/proc/self/fd/{fd}").readlink()
        return str(name) if os.path.samestat(name.stat(), mine) else ""
    except OSError:
        return ""
