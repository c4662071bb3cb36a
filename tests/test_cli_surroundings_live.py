"""A robot that is up, and commands that go on, in surroundings that lack something: no /proc, no reader any more."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from operator_shell import PATIENCE_S, Shell

from apps.cli import exits

pytestmark = pytest.mark.process


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    with Shell(tmp_path) as shell:
        yield shell


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "apps.cli.main", *arguments]


def test_without_proc_a_robot_comes_up_and_top_says_what_it_cannot_measure(shell: Shell) -> None:
    inside = ["unshare", "--mount", "sh", "-c", 'mount -t tmpfs none /proc || exit 77; exec "$@"', "sh"]

    def cocoro(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*inside, *command(*arguments)], env=shell.env, capture_output=True, text=True, timeout=PATIENCE_S
        )

    try:
        started = cocoro("up", shell.profile("good"), "--detach")
    except FileNotFoundError:
        pytest.skip("there is no unshare(1) here")
    if started.returncode not in (exits.DONE, exits.FAILED) or "unshare failed" in started.stderr:
        pytest.skip(f"no mounts of one's own here: {started.stderr}")
    assert started.returncode == exits.DONE, started.stdout + started.stderr
    shown = cocoro("top", "--once")
    assert (shown.returncode, shown.stderr) == (exits.DONE, "")
    assert "cpu unknown (no /proc)" in shown.stdout
    assert "good" in shown.stdout
    assert "/proc cannot be read" in shell.run_dir.log("good").read_text()
    assert cocoro("down").returncode == exits.DONE


def test_who_listens_for_ever_ends_when_nobody_reads_it_any_more(shell: Shell) -> None:
    """Nothing else ends such a command in the background of a script, where Ctrl-C is ignored."""
    assert shell("up", shell.profile("good"), "--detach").returncode == exits.DONE
    listening = subprocess.Popen(
        command("echo", "*/health"),
        env=shell.env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert listening.stdout is not None
    assert listening.stderr is not None
    assert listening.stdout.readline()
    listening.stdout.close()
    assert listening.wait(PATIENCE_S) == exits.FAILED
    assert listening.stderr.read() == b""  # its reader has read what it wanted
    listening.stderr.close()


def test_a_robot_minds_no_reader_that_has_gone(shell: Shell) -> None:
    running = subprocess.Popen(
        command("up", shell.profile("good")), env=shell.env, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert running.stdout is not None
    assert running.stderr is not None
    assert b"good ready" in running.stdout.readline()
    running.stdout.close()
    with closing(shell.target("good")) as good:
        good.signal(signal.SIGKILL)  # the supervisor reports it; no process reads that
        assert good.wait(PATIENCE_S)
    while "good" not in shell.run_dir.claims():
        time.sleep(0.02)
    assert running.poll() is None
    running.terminate()
    assert running.wait(PATIENCE_S) == exits.FAILED  # not all of its words have arrived
    assert running.stderr.read() == b""
    running.stderr.close()
