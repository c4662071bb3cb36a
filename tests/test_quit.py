"""The end of a process: what was begun is finished, and no thread of zenoh's turns a success into an abort."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.quit import UNFLUSHED

PATIENCE_S = 60.0


def ended(script: str, *arguments: Path) -> tuple[int, str, str]:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    return run.returncode, run.stdout, run.stderr


@pytest.mark.process
def test_it_ends_with_its_code_after_threads_exit_functions_and_what_was_printed() -> None:
    script = """
import atexit, threading
from concurrent.futures import ThreadPoolExecutor
from deploy.quit import quit_process
begun, last = threading.Event(), threading.Event()
def work():
    begun.set()
    last.wait()
    print("worked", end=" ")
executor = ThreadPoolExecutor()
executor.submit(work)
begun.wait()
atexit.register(lambda: print("exit function", end=" "))
threading.Timer(0.0, last.set).start()
quit_process(3)
"""
    assert ended(script) == (3, "worked exit function ", "")


@pytest.mark.process
def test_nobody_to_read_its_last_words_changes_no_exit_code() -> None:
    script = "import sys; from deploy.quit import quit_process; print('words'); sys.stdout.close(); quit_process(0)"
    assert ended(script)[0] == 0


@pytest.mark.process
def test_what_it_could_not_print_is_an_error() -> None:
    script = "from deploy.quit import quit_process; print('words'); quit_process(0)"
    buffered = os.environ | {"PYTHONUNBUFFERED": ""}
    with Path("/dev/full").open("w") as full:
        run = subprocess.run([sys.executable, "-c", script], stdout=full, env=buffered, timeout=PATIENCE_S)
    assert run.returncode == UNFLUSHED


CAUGHT_IN_A_CALLBACK = """
import json, sys, threading, time
import zenoh
from deploy.quit import quit_process

class Long:
    def __del__(self, sleep=time.sleep):
        sleep(1.0)

sys.long = Long()  # so long the interpreter is taken apart, where it is

def session(mode, place):
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    for way in ("listen", "connect"):
        config.insert_json5(f"{way}/endpoints", json.dumps([place] if way == mode else []))
    return zenoh.open(config)

def on_sample(sample, sleep=time.sleep):
    called.set()
    sleep(0.3)  # and asks for the interpreter again

called = threading.Event()
receiver, sender = (session(mode, f"unixsock-stream/{sys.argv[1]}/socket") for mode in ("listen", "connect"))
subscriber = receiver.declare_subscriber("key", zenoh.handlers.Callback(on_sample, indirect=False))
while not called.wait(0.01):
    sender.put("key", b"")
print("done")
"""


@pytest.mark.process
@pytest.mark.zenoh
def test_a_thread_of_zenoh_that_comes_back_late_aborts_nothing(short_path: Path) -> None:
    assert ended(CAUGHT_IN_A_CALLBACK + "quit_process(0)", short_path) == (0, "done\n", "")
