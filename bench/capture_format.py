"""How fast captures are written and read: by the code here, and by the mcap package alone.

    python bench/capture_format.py [--seconds 5] [--times 5]

Both write by zstd, as each does it by itself, the messages of a rehearsed fetch (30 frames of 1.54 MB and some 800
small messages a second), and read the same files, in turn in one run. The figures are times of this process, reader
threads included, the middle one of all turns; a ratio is that of the package over that of the code here. Files are on a disk in memory
where there is one, so no disk is measured.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as PackageWriter

from cocoro.capture.compression import Packer
from cocoro.capture.keys import info_of
from cocoro.capture.reader import Capture
from cocoro.capture.writer import Entry, Limits, Writer
from cocoro.clock import NS
from cocoro.rehearsal import RehearsalRequest
from sim.rehearse import rehearse

SMALL_BYTES = 64 * 1024
MEMORY = Path("/dev/shm")


def recorded(folder: Path, sensors: Literal["ideal", "real"], seconds: float) -> list[Entry]:
    """The first messages of a rehearsed fetch, in order."""
    path = folder / f"{sensors}.mcap"
    rehearse(RehearsalRequest(task="fetch", label="red_can", sensors=sensors, record=str(path)))
    with Capture.open(path) as capture:
        end_ns = capture.start_ns + round(seconds * NS)
        made = [Entry(*record[:4], bytes(record[4])) for record in capture.messages(end_ns=end_ns)]
    path.unlink()
    return made


def write_here(made: list[Entry], out: Path) -> None:
    writer = Writer(lambda _: out, Packer("zstd"), Limits(), lambda key, payload: info_of(key, "calliope", payload))
    due_ns = made[0].log_ns
    for one in made:
        if one.log_ns >= due_ns:  # as the recorder does it
            writer.flush()
            due_ns += NS // 10
        writer.put(one)
    writer.close()


def write_by_package(made: list[Entry], out: Path) -> None:
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
    """Seconds of processor of each way, the middle of so many turns."""
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(times):
        for name, way in ways.items():
            started = time.process_time()
            way()
            spent[name].append(time.process_time() - started)
    return {name: statistics.median(all_s) for name, all_s in spent.items()}


def peak_of_a_frame(folder: Path, frame: Entry) -> float:
    """MB that writing one frame takes at the peak, beside the frame itself."""
    writer = Writer(lambda _: folder / "peak.mcap", Packer("zstd"), Limits(), lambda *_: info_of(*_of(frame)))
    writer.put(frame)
    tracemalloc.start()
    writer.put(frame._replace(log_ns=frame.log_ns + 1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    writer.close()
    return peak / 1e6


def _of(frame: Entry) -> tuple[str, str, bytes]:
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


def _compare(folder: Path, name: str, made: list[Entry], times: int) -> None:
    out, paths = folder / "out.mcap", [folder / "here.mcap", folder / "package.mcap"]

    def anew(write: Callable[[list[Entry], Path], None]) -> Callable[[], None]:
        def way() -> None:
            write(made, out)
            out.unlink()

        return way

    spent = in_turn(times, here=anew(write_here), package=anew(write_by_package))
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="cocoro-", dir=MEMORY if MEMORY.is_dir() else None) as folder:
        compare(Path(folder), options.seconds, options.times)


if __name__ == "__main__":
    main()
