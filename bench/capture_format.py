"""Compares the speed of writing and reading captures with the `mcap` package's.

    python -m bench capture-format [files] [records] [--seconds 4] [--times 5]

`files`: both write the messages of a rehearsed fetch (30 frames of 1.54 MB and some 800 small messages a second)
with zstd, each in its own way, and read the same files. `records`: each kind of record that is encoded or decoded
here, and a frame that is joined with its head before compression or compressed piece by piece. The two take turns
in one run. The figures are this process's CPU time, reader threads included. Files are in memory (/dev/shm) where
possible, so no disk is measured.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tracemalloc
import zlib
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from statistics import median

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType
from mcap.writer import Writer as PackageWriter

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.report import Report, Table, number, turns
from bench.trials import number_of, one_of, sized
from cocoro.capture import mcap
from cocoro.capture.contents import unpacked
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import CocoroError
from services.capture import file, packing
from services.capture.keys import QueuedMessage, info_of
from services.capture.packing import QUICK, Packer, behind_start
from services.capture.writer import CaptureWriter, FileLimits
from services.executive.tasks import FetchTask
from sim.kinds import Sensors

SMALL_BYTES = 64 * 1024
MEMORY = Path("/dev/shm")


PARTS = ("files", "records")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "parts", nargs="*", type=one_of(PARTS), metavar="PART", help=f"{', '.join(PARTS)}; without one both"
    )
    parser.add_argument("--seconds", type=float, help="of the fetch (4)")
    parser.add_argument("--times", type=number_of, help="turns (5)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    seconds, times = sized(chosen, chosen.seconds, 4.0, 1.2), sized(chosen, chosen.times, 5, 3)
    kinds: tuple[Sensors, ...] = ("ideal", "real")
    with tempfile.TemporaryDirectory(prefix="cocoro-", dir=MEMORY if MEMORY.is_dir() else None) as name:
        folder = Path(name)
        made = {sensors: recorded(folder, sensors, seconds) for sensors in kinds}
        comparison = Comparison(report, times)
        if "files" in (chosen.parts or PARTS):
            files(folder, made, comparison, report)
        if "records" in (chosen.parts or PARTS):
            records(made, comparison, report)
        report.tables.append(Table("CPU time, ms", ["what", "here", "by the package"], comparison.rows))


def recorded(folder: Path, sensors: Sensors, seconds: float) -> list[QueuedMessage]:
    """The messages of the first seconds of a rehearsed fetch, in order."""
    path = folder / f"{sensors}.mcap"
    rehearse(RehearsalRequest(task=FetchTask(label="red_can"), sensors=sensors, timeout_s=seconds, record=str(path)))
    with Capture.open(path) as capture:
        made = [
            QueuedMessage(one.key, one.sequence, one.log_ns, one.publish_ns, bytes(one.payload))
            for one in capture.messages()
        ]
    path.unlink()
    return made


def write_here(made: list[QueuedMessage], out: Path) -> None:
    writer = CaptureWriter(
        lambda _: out, Packer("zstd"), FileLimits(), lambda key, payload: info_of(key, "calliope", payload)
    )
    due_ns = made[0].log_ns
    for one in made:
        if one.log_ns >= due_ns:  # as the recorder does
            writer.flush()
            due_ns += NS // 10
        writer.put(one)
    writer.close()


def write_by_package(made: list[QueuedMessage], out: Path) -> None:
    with out.open("wb") as file:
        writer = PackageWriter(file, compression=CompressionType.ZSTD)
        writer.start(profile="cocoro")
        channels: dict[str, int] = {}
        for key, sequence, log_ns, publish_ns, payload, *_ in made:
            if key not in channels:
                info = info_of(key, "calliope", payload)
                schema = 0 if info.schema is None else writer.register_schema(*info.schema)
                channels[key] = writer.register_channel(key, info.encoding, schema, info.metadata)
            writer.add_message(channels[key], log_ns, payload, publish_ns, sequence)
        writer.finish()


def read_here(path: Path) -> int:
    with Capture.open(path) as capture:
        return sum(len(record.payload) for record in capture.messages())


def read_by_package(path: Path) -> int:
    with path.open("rb") as file:
        return sum(len(message.data) for _, _, message in make_reader(file, validate_crcs=True).iter_messages())


def _spent(action: Callable[[], object], repeat: int = 1) -> Callable[[], float]:
    """A function that returns the CPU time of a call of `action`, ms: the mean of so many."""

    def way() -> float:
        begun_ns = time.process_time_ns()
        for _ in range(repeat):
            action()
        return (time.process_time_ns() - begun_ns) / 1e6 / repeat

    return way


class Comparison:
    """The two take turns, so many times. Ratios are figures, and the times are rows of a table."""

    def __init__(self, report: Report, times: int) -> None:
        self._report = report
        self.times = times
        self.rows: list[list[str]] = []

    def tell(
        self, name: str, here: Callable[[], object], package: Callable[[], object], repeat: int = 1, ratio: bool = True
    ) -> None:
        """Short actions are measured `repeat` times at once. Without `ratio` there is only the row: the ratio would
        depend on how much is packed, and so on the form of the run."""
        ours, theirs = turns(self.times, here=_spent(here, repeat), package=_spent(package, repeat))
        if ratio:
            self._report.ratio(f"{name}: the package / here", theirs, ours, better="more")
        self.rows.append([name, number(median(ours)), number(median(theirs))])


def peak_of_a_frame(folder: Path, frame: QueuedMessage) -> float:
    """Memory that writing one frame takes at the peak besides the frame, MB."""
    writer = CaptureWriter(
        lambda _: folder / "peak.mcap", Packer("zstd"), FileLimits(), lambda *_: info_of(*_of(frame))
    )
    writer.put(frame)
    tracemalloc.start()
    writer.put(frame._replace(log_ns=frame.log_ns + 1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    writer.close()
    return peak / 1e6


def _of(frame: QueuedMessage) -> tuple[str, str, bytes]:
    return frame.key, "calliope", frame.payload


def files(folder: Path, made: dict[Sensors, list[QueuedMessage]], comparison: Comparison, report: Report) -> None:
    for sensors, messages in made.items():
        small = [one for one in messages if len(one.payload) < SMALL_BYTES]
        _compare(folder, f"{sensors} sensors, frames and small messages", messages, comparison)
        _compare(folder, f"{sensors} sensors, small messages alone", small, comparison, repeat=5)
        frame = next(one for one in messages if one.key.endswith("kinect/frame"))
        report.value(
            f"{sensors} sensors: memory to write a frame of {len(frame.payload) / 1e6:.2f} MB",
            [peak_of_a_frame(folder, frame)], "MB",
        )  # fmt: skip
        (folder / "peak.mcap").unlink()


def _compare(folder: Path, name: str, made: list[QueuedMessage], comparison: Comparison, repeat: int = 1) -> None:
    out, paths = folder / "out.mcap", {"a file of ours": folder / "here.mcap", "one of its": folder / "package.mcap"}

    def into_a_new_file(write: Callable[[list[QueuedMessage], Path], None]) -> Callable[[], None]:
        def way() -> None:
            write(made, out)
            out.unlink()

        return way

    comparison.tell(f"{name}, written", into_a_new_file(write_here), into_a_new_file(write_by_package), repeat)
    write_here(made, paths["a file of ours"])
    write_by_package(made, paths["one of its"])
    for whose, path in paths.items():
        if read_here(path) != read_by_package(path):
            raise CocoroError(f"{name}: {whose}: the two read different messages")
        comparison.tell(f"{name}, {whose} read", partial(read_here, path), partial(read_by_package, path), repeat)
        path.unlink()


def records(made: dict[Sensors, list[QueuedMessage]], comparison: Comparison, report: Report) -> None:
    payload, count, places = bytes(220), 1000, list(range(40))

    def write_messages() -> bytes:
        head = packing.message_head
        return b"".join(part for n in range(count) for part in (head(3, n, n, n, len(payload)), payload))

    def write_messages_by_package() -> bytes:
        return file.packed(*(Message(3, n, payload, n, n) for n in range(count)))

    raw = write_messages()
    assert raw == write_messages_by_package()
    small = Chunk("", raw, 0, 0, 0, len(raw))
    some = list(zip(places[::2], places[1::2], strict=True))
    assert file.message_index(3, places) == file.packed(MessageIndex(3, some))
    name = f"{count} messages of {len(payload)} bytes"
    comparison.tell(f"{name}, written", write_messages, write_messages_by_package, 20)
    comparison.tell(
        f"{name}, read",
        lambda: [mcap.message(content) for _, content, _ in mcap.records(raw)],
        lambda: breakup_chunk(small),
        20,
    )
    comparison.tell(
        f"{count} indices of {len(some)} messages, written",
        lambda: [file.message_index(3, places) for _ in range(count)],
        lambda: [file.packed(MessageIndex(3, some)) for _ in range(count)],
        5,
    )
    for sensors, messages in made.items():
        frames = [one.payload for one in messages if one.key.endswith("kinect/frame")][::4]
        _frames(f"frames, {sensors} sensors", frames, comparison, report)


def _frames(name: str, frames: list[bytes], comparison: Comparison, report: Report) -> None:
    head = bytes(mcap.MESSAGE_HEAD.size)
    raws = [head + frame for frame in frames]
    packer = zstandard.ZstdCompressor(compression_params=QUICK)
    packed = [(packer.compress(raw), len(raw), zlib.crc32(raw)) for raw in raws]
    contents = [file.packed(Chunk("zstd", data, 0, 0, crc, size))[9:] for data, size, crc in packed]

    def write() -> None:
        for data, size, crc in packed:  # the head, and the packed records unchanged
            file.chunk_head(mcap.ChunkHead(0, 0, size, crc, "zstd", len(data)))

    def write_by_package() -> None:
        for data, size, crc in packed:
            file.packed(Chunk("zstd", data, 0, 0, crc, size))

    comparison.tell(f"{name}, packed, chunk records made", write, write_by_package, 200, ratio=False)

    def read() -> None:
        for content in contents:
            unpacked(content, strict=True)

    def read_by_package() -> None:
        for content in contents:
            breakup_chunk(Chunk.read(ReadDataStream(BytesIO(content))), validate_crc=True)

    comparison.tell(f"{name}, chunk records read", read, read_by_package)

    def joined() -> None:
        for frame in frames:
            raw = b"".join((head, frame))
            mcap.crc32(raw)
            packer.compress(raw)

    def behind() -> None:
        for frame in frames:
            mcap.crc32(frame, mcap.crc32(head))
            behind_start(head, packer.compress(frame))

    def in_pieces() -> None:
        for frame in frames:
            mcap.crc32(frame, mcap.crc32(head))
            stream = packer.compressobj(size=len(head) + len(frame))
            _ = [stream.compress(head), stream.compress(frame), stream.flush()]

    together, after, apart = turns(
        comparison.times, joined=_spent(joined), behind=_spent(behind), pieces=_spent(in_pieces)
    )
    report.value(f"{name}: joined and packed, each", [each / len(frames) for each in together], "ms")
    report.ratio(f"{name}: packed, then put behind its head / joined and packed", after, together, better="less")
    report.ratio(f"{name}: packed in pieces / joined and packed", apart, together, better="more")
