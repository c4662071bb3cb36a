"""A bench that is ended stops what it started."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

BENCH = """
import asyncio, subprocess, sys
from bench.ended import leave_when_ended

async def wait():
    with subprocess.Popen([sys.executable, "-c", "import time; print('runs', flush=True); time.sleep(600)"]) as command:
        await asyncio.to_thread(command.wait)

leave_when_ended()
try:
    asyncio.run(wait())
finally:
    print("stopped", flush=True)
"""


def test_sigterm_ends_its_commands_and_leaves_its_contexts() -> None:
    bench = subprocess.Popen(
        [sys.executable, "-c", BENCH], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    with bench:
        assert bench.stdout is not None
        assert bench.stdout.readline() == "runs\n"
        bench.send_signal(signal.SIGTERM)
        assert bench.communicate(timeout=60)[0] == "stopped\n"
    assert bench.returncode == 128 + signal.SIGTERM
