"""Compares the speed of writing and reading captures with the mcap package's.

    python bench/capture_format.py files [--seconds 5] [--times 5]
    python bench/capture_format.py records [--times 5]

`files`: both write the messages of a rehearsed fetch (30 frames of 1.54 MB and some 800 small messages a second)
with zstd, each in its own way, and read the same files. `records`: each kind of record that is encoded or decoded
here, and a frame that is joined with its head before compression or compressed piece by piece. The two take turns
in one run. The figures are medians of this process's CPU time, reader threads included; a ratio is the package's
time over that of the code here. Files are in memory (/dev/shm) where possible, so no disk is measured.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import tracemalloc
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType
from mcap.writer import Writer as PackageWriter

from apps.captures.contents import unpacked
from apps.captures.reader import Capture
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.capture import mcap
from cocoro.clock import NS
from services.capture import file, packing
from services.capture.keys import QueuedMessage, info_of
from services.capture.packing import QUICK, Packer
from services.capture.writer import CaptureWriter, FileLimits
from services.executive.tasks import FetchTask
from sim.realism import Sensors

SMALL_BYTES = 64 * 1024
MEMORY = Path("/dev/shm")


def recorded(folder: Path, sensors: Sensors, seconds: float) -> list[QueuedMessage]:
    """The first messages of a rehearsed fetch, in order."""
    path = folder / f"{sensors}.mcap"
    rehearse(RehearsalRequest(task=FetchTask(label="red_can"), sensors=sensors, record=str(path)))
    with Capture.open(path) as capture:
        end_ns = capture.start_ns + round(seconds * NS)
        made = [
            QueuedMessage(one.key, one.sequence, one.log_ns, one.publish_ns, bytes(one.payload))
            for one in capture.messages(end_ns=end_ns)
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


def in_turn(times: int, **ways: Callable[[], object]) -> dict[str, float]:
    """Median CPU time of each way, s, over so many turns."""
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(times):
        for name, way in ways.items():
            started = time.process_time()
            way()
            spent[name].append(time.process_time() - started)
    return {name: statistics.median(all_s) for name, all_s in spent.items()}


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


def compare(folder: Path, seconds: float, times: int) -> None:
    for sensors in ("ideal", "real"):
        made = recorded(folder, sensors, seconds)
        small = [one for one in made if len(one.payload) < SMALL_BYTES]
        for name, some in (("frames and small messages", made), ("small messages alone", small)):
            _compare(folder, f"{sensors} sensors, {name}", some, times)
        frame = next(one for one in made if one.key.endswith("kinect/frame"))
        print(f"one frame of {len(frame.payload) / 1e6:.2f} MB takes {peak_of_a_frame(folder, frame):.2f} MB more")
        (folder / "peak.mcap").unlink()


def _compare(folder: Path, name: str, made: list[QueuedMessage], times: int) -> None:
    out, paths = folder / "out.mcap", [folder / "here.mcap", folder / "package.mcap"]

    def into_a_new_file(write: Callable[[list[QueuedMessage], Path], None]) -> Callable[[], None]:
        def way() -> None:
            write(made, out)
            out.unlink()

        return way

    spent = in_turn(times, here=into_a_new_file(write_here), package=into_a_new_file(write_by_package))
    print(f"{name}: {len(made)} messages, {sum(len(one.payload) for one in made) / 1e6:.0f} MB")
    print(f"  written here {spent['here']:.3f} s, by the package {spent['package']:.3f} s: {_ratio(spent):.1f} times")
    write_here(made, paths[0])
    write_by_package(made, paths[1])
    for path in paths:
        assert read_here(path) == read_by_package(path)
        spent = in_turn(times, here=lambda p=path: read_here(p), package=lambda p=path: read_by_package(p))  # type: ignore[misc]
        size = f"{path.name}, {path.stat().st_size / 1e6:.1f} MB"
        print(f"  {size}: read here {spent['here']:.3f} s, by the package {spent['package']:.3f} s: ", end="")
        print(f"{_ratio(spent):.1f} times")
        path.unlink()


def _ratio(spent: dict[str, float]) -> float:
    return spent["package"] / spent["here"]


def records(folder: Path, times: int) -> None:
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
    _tell(f"{count} messages of {len(payload)} bytes, written", times, write_messages, write_messages_by_package)
    _tell(
        "the same, read", times,
        lambda: [mcap.message(content) for _, content, _ in mcap.records(raw)],
        lambda: breakup_chunk(small),
    )  # fmt: skip
    _tell(
        f"{count} indices of {len(some)} messages, written", times,
        lambda: [file.message_index(3, places) for _ in range(count)],
        lambda: [file.packed(MessageIndex(3, some)) for _ in range(count)],
    )  # fmt: skip
    for sensors in ("ideal", "real"):
        frames = [one.payload for one in recorded(folder, sensors, 3.0) if one.key.endswith("kinect/frame")][::4]
        _frames(f"{len(frames)} frames, {sensors} sensors", frames, times)


def _frames(name: str, frames: list[bytes], times: int) -> None:
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

    _tell(f"{name}, packed: chunk records made", times, write, write_by_package)

    def read() -> None:
        for content in contents:
            unpacked(content, strict=True)

    def read_by_package() -> None:
        for content in contents:
            breakup_chunk(Chunk.read(ReadDataStream(BytesIO(content))), validate_crc=True)

    _tell(f"{name}: chunk records read", times, read, read_by_package)

    def joined() -> None:
        for frame in frames:
            raw = b"".join((head, frame))
            zlib.crc32(raw)
            packer.compress(raw)

    def in_pieces() -> None:
        for frame in frames:
            zlib.crc32(frame, zlib.crc32(head))
            stream = packer.compressobj(size=len(head) + len(frame))
            _ = [stream.compress(head), stream.compress(frame), stream.flush()]

    spent = in_turn(times, here=joined, pieces=in_pieces)
    print(f"{name}: joined and packed {1e3 * spent['here'] / len(frames):.2f} ms each, ", end="")
    print(f"packed in pieces {1e3 * spent['pieces'] / len(frames):.2f} ms")


def _tell(name: str, times: int, here: Callable[[], object], package: Callable[[], object]) -> None:
    spent = in_turn(times, here=here, package=package)
    print(f"{name}: here {1e3 * spent['here']:.2f} ms, by the package {1e3 * spent['package']:.2f} ms: ", end="")
    print(f"{_ratio(spent):.1f} times")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("files", "records"))
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="cocoro-", dir=MEMORY if MEMORY.is_dir() else None) as folder:
        if options.what == "records":
            records(Path(folder), options.times)
        else:
            compare(Path(folder), options.seconds, options.times)


if __name__ == "__main__":
    main()
