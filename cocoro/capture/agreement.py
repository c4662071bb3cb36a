"""Whether what a file says of itself agrees with what was read of it: its statistics, its index of metadata, the
checksums of its metadata. What does not agree is told as damage. A file without statistics has none to contradict."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from mcap.records import Metadata, Statistics

from cocoro.capture.contents import Contents
from cocoro.capture.file import CHECKSUM, TALLY, checksum

RECORDERS_NAMES = ("run", "robot", "profile", TALLY)
"""Metadata that every recorder writes; beside these, `service/` and a service's name."""


def compare(found: Contents) -> None:
    """Add to the file's problems what does not agree, and take away metadata that is not what was written."""
    _keep_written(found)
    found.problems += _contradictions(found)
    if not found.ours or not found.closed:
        return
    if found.statistics is None and not found.problems:
        found.problems.append("its statistics are missing, which every recorder writes")
    if all(each.name != TALLY for each in found.metadata):
        found.problems.append(f"its metadata {TALLY!r} is missing, which every recorder writes")


def miscounted(
    statistics: Statistics, counts: Mapping[int, int], channels: Collection[int], of_all: bool
) -> Iterator[str]:
    """In words, where the statistics say another number of messages than was counted: in the whole file, when the
    counts are `of_all` channels, else by channel. Files may state the first without the second."""
    counted = sum(counts.values())
    if of_all and statistics.message_count != counted:
        yield f"its statistics say {statistics.message_count} messages, and {counted} can be read"
        return
    told = statistics.channel_message_counts
    for channel in sorted(channels) if told else ():
        said, has = told.get(channel, 0), counts.get(channel, 0)
        if said != has:
            yield f"its statistics say {said} messages of channel {channel}, and {has} can be read"


def _contradictions(found: Contents) -> Iterator[str]:
    """Whatever was read from front to back is held against the statistics; what was taken from the summary has been."""
    told = found.statistics
    if told is None or found.summarised:
        return
    yield from miscounted(told, found.messages, found.channels.keys() | found.messages.keys(), of_all=True)
    for said, has, words in (
        (told.schema_count, len(found.schemas), "schemas"),
        (told.channel_count, len(found.channels), "channels"),
        (told.chunk_count, found.chunks, "chunks"),
        (told.attachment_count, len(found.attachments), "attachments"),
        (told.metadata_count, len(found.metadata), "metadata records"),
    ):
        if said != has:
            yield f"its statistics say {said} {words}, and {has} can be read"


def _keep_written(found: Contents) -> None:
    """A header that is damaged makes a recorder's file look like another's, whose metadata need no checksums. So where
    one record has the checksum of a recorder, each that has one, or has a name that recorders give, is held against it.
    A record's name is in no checksum, so it is held against the summary's index."""
    sealed = any(each.metadata.get(CHECKSUM) == checksum(each.metadata) for each in found.metadata)
    kept: list[tuple[int, Metadata]] = []
    if not sealed:
        return
    if not found.header_right:
        found.problems.append("the file's header is damaged")
    for at, each in zip(found.metadata_at, found.metadata, strict=True):
        needless = CHECKSUM not in each.metadata and not _recorders_name(each.name)
        right = needless or each.metadata.get(CHECKSUM) == checksum(each.metadata)
        if right and _named(found.metadata_told, at, each.name):
            kept.append((at, each))
        else:
            found.problems.append(f"the metadata {each.name!r} at byte {at} is not what was written")
    found.metadata_at, found.metadata = [at for at, _ in kept], [each for _, each in kept]


def _recorders_name(name: str) -> bool:
    return name in RECORDERS_NAMES or name.startswith("service/")


def _named(told: Mapping[int, str], at: int, name: str) -> bool:
    """Whether the index, if there is one, has a record of this name: at this place, or where records were moved
    because bytes before them are missing, at any."""
    return not told or (told[at] == name if at in told else name in told.values())
