"""Decodes MCAP records that only readers need: attachments, indices, and the contents of chunks. Pure, as
`cocoro.capture.mcap`."""

from __future__ import annotations

import struct
from io import BytesIO

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Attachment, AttachmentIndex, ChunkIndex, Footer

from cocoro.capture.mcap import PREFIX, Bytes, DamageError, ExactStream, crc32, footer_crc, parsed

_CHUNK_INDEX, _INDEX_OFFSET = struct.Struct("<QQQQI"), struct.Struct("<HQ")
_AFTER_OFFSETS, _SIZES = struct.Struct("<QI"), struct.Struct("<QQ")
KNOWN = ("", "zstd", "lz4")
"""A chunk's compression, as its head names it."""
LARGEST_CHUNK = 4 << 30
"""Bytes, compressed or not; the limit of the `mcap` package. A chunk that claims more is damaged."""


def chunk_index(content: Bytes) -> ChunkIndex:
    """Raises DamageError for content that cannot be the index of a chunk. A quarter of the package's time: a capture of
    an hour has 36,000 of them."""
    try:
        start_ns, end_ns, at, length, size = _CHUNK_INDEX.unpack_from(content)
        middle = _CHUNK_INDEX.size + size
        if size % _INDEX_OFFSET.size or middle > len(content):
            raise DamageError("the index of a chunk has a wrong length")
        indices = dict(_INDEX_OFFSET.iter_unpack(content[_CHUNK_INDEX.size : middle]))
        index_bytes, name_bytes = _AFTER_OFFSETS.unpack_from(content, middle)
        name_at = middle + _AFTER_OFFSETS.size
        name = str(content[name_at : name_at + name_bytes], "utf-8")
        packed_bytes, raw_bytes = _SIZES.unpack_from(content, name_at + name_bytes)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamageError("the index of a chunk is damaged") from error
    return ChunkIndex(
        chunk_length=length, chunk_start_offset=at, compression=name, compressed_size=packed_bytes,
        message_end_time=end_ns, message_index_length=index_bytes, message_index_offsets=indices,
        message_start_time=start_ns, uncompressed_size=raw_bytes,
    )  # fmt: skip


def attachment_index(content: Bytes, offset: int, length: int) -> tuple[AttachmentIndex, int]:
    """Read an attachment's head from the start of its record. Returns its index and the offset of its data in the
    record.

    `offset` and `length` are those of the record with its prefix. Raises DamageError. The package reads an attachment
    only with all its data, however large.
    """
    stream = ExactStream(BytesIO(content))
    try:
        log_time, create_time = stream.read8(), stream.read8()
        name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
        size = stream.read8()
    except (UnicodeDecodeError, EndOfFile) as error:
        raise DamageError("an attachment's head is damaged") from error
    if PREFIX.size + stream.count + size + 4 > length:
        raise DamageError("an attachment is longer than its record")
    return AttachmentIndex(offset, length, log_time, create_time, size, name, media_type), stream.count


def attachment(content: Bytes, strict: bool) -> Attachment:
    """Returns an attachment whose checksum is right. Without `strict` a checksum of 0 means that there is none. Raises
    DamageError. The package does not check it."""
    found, taken = parsed(Attachment, content)
    view = memoryview(content)
    (crc,) = struct.unpack("<I", view[taken - 4 : taken])
    if crc != crc32(view[: taken - 4]) and (strict or crc != 0):
        raise DamageError(f"the checksum of the attachment {found.name!r} is wrong")
    return found


def checksum_is_right(footer: Footer, summary: bytes, strict: bool) -> bool:
    """Whether the summary section is as it was written. Without `strict` a checksum of 0 counts as right."""
    if footer.summary_crc == 0 and not strict:
        return True
    return footer.summary_crc == footer_crc(summary, footer.summary_start, footer.summary_offset_start)


def check_message_index(content: Bytes) -> int:
    """The number of bytes that the index takes. Raises DamageError for content that cannot be an index."""
    length = struct.unpack_from("<I", content, 2)[0] if len(content) >= 6 else 1
    if length % 16 or 6 + length > len(content):
        raise DamageError("a message index has a wrong length")
    return 6 + int(length)


def index_entries(content: Bytes) -> tuple[int, list[tuple[int, int]]]:
    """Parse a checked message index: the channel's number, and log time, ns, and offset of each message."""
    channel, length = struct.unpack_from("<HI", content)
    return channel, list(struct.iter_unpack("<QQ", content[6 : 6 + length]))


def unpack(name: str, packed: bytes | memoryview, raw_bytes: int) -> bytes | memoryview:
    """Returns the uncompressed bytes of a chunk. Raises DamageError when they cannot be unpacked, or are not
    `raw_bytes` many."""
    if raw_bytes > LARGEST_CHUNK:
        raise DamageError(f"a chunk claims to have {raw_bytes} bytes")
    try:
        raw = _unpack(name, packed, raw_bytes)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError) as error:
        raise DamageError(f"a chunk cannot be unpacked: {error}") from error
    if len(raw) != raw_bytes:
        raise DamageError(f"a chunk has {len(raw)} bytes instead of {raw_bytes}")
    return raw


def _unpack(name: str, packed: bytes | memoryview, raw_bytes: int) -> bytes | memoryview:
    if name == "":
        return packed
    if name == "zstd":
        if zstandard.frame_content_size(packed) not in (-1, raw_bytes):  # before that much memory is allocated
            raise DamageError("a chunk states two different sizes")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=raw_bytes)
    if name == "lz4":
        # One byte more than `raw_bytes` shows that there are too many, without unpacking all of them.
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=raw_bytes + 1))
    raise DamageError(f"a chunk is compressed by {name!r}, which is unknown")
