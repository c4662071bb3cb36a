"""Makes the golden capture: `python tests/golden/make.py`.

Only for a change that is meant to alter the outputs of perception or planning. The test that re-executes the
capture finds changes that are not.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from apps.captures.reexecute import describe_result, reexecute
from apps.captures.rewrite import rewrite
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from services.capture.keys import KeyFilter
from services.capture.packing import Packer
from services.executive.tasks import FetchTask

GOLDEN = Path(__file__).with_name("fetch.mcap")
LENGTH_S = 6.0
LARGEST_BYTES = 1_000_000


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "fetch.mcap"
        rehearse(
            RehearsalRequest(
                task=FetchTask(label="red_can"), width=160, height=120, frame_rate_hz=10.0, record=str(whole)
            )
        )
        GOLDEN.unlink(missing_ok=True)
        with Capture.open(whole) as capture:
            choice = KeyFilter(capture.robot, without=["sim/truth"])
            done = rewrite(
                capture,
                GOLDEN,
                Packer("zstd", 19),
                keep=lambda record: record.key in choice,
                end_ns=capture.start_ns + round(LENGTH_S * NS),
            )
    print(f"{GOLDEN}: {done.messages} messages, {done.size_bytes} bytes")
    assert done.size_bytes < LARGEST_BYTES
    for service in ("perception", "planning"):
        with Capture.open(GOLDEN) as capture:
            print("\n".join(describe_result(reexecute([capture], service))))


if __name__ == "__main__":
    main()
