"""Processes that hang: how the supervisor notices them, and what it takes for no hang."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from operator_shell import Shell

from cocoro.errors import ConfigError
from deploy import heartbeat
from deploy.heartbeat import GRACE, HANGS_S, LATE_S, STOPPED_S, Grace, Pulse, Use, grace, use_of


class Process:
    """What /proc tells of a process, second by second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.use: Use | None = Use("S", 0.0, 0.0, traced=False)
        self.pulse = Pulse()
        self.beats = 0
        monkeypatch.setattr(heartbeat, "use_of", lambda _: self.use)
        self.beat()

    def beat(self) -> None:
        self.beats += 1
        os.pwrite(self.pulse.fd, self.beats.to_bytes(8, "little"), 0)
        self.pulse.feel(1, 1.0)

    def passes(self, seconds: int, *, state: str = "S", ran: float = 0.0, waited: float = 0.0) -> float:
        """Let seconds pass without a beat, in each of which it ran and waited for so long; returns for how long its
        loop has been still."""
        for _ in range(seconds):
            if self.use is not None:
                before = self.use
                self.use = before._replace(state=state, ran_s=before.ran_s + ran, waited_s=before.waited_s + waited)
            self.pulse.feel(1, 1.0)
        return self.pulse.still_s


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    it = Process(monkeypatch)
    yield it
    it.pulse.close()


def test_time_without_a_beat_counts_while_the_process_could_run(process: Process) -> None:
    assert process.passes(3, state="T") == 3.0
    assert process.passes(2, state="S") == 5.0
    assert process.passes(4, state="R", ran=1.0) == 9.0
    process.beat()
    assert process.pulse.still_s == 0.0


def test_time_in_which_it_waits_for_a_processor_or_a_device_does_not_count(process: Process) -> None:
    assert process.passes(60, state="R", ran=0.0) == 0.0, "it never got a processor"
    assert process.passes(10, state="R", ran=0.25) == 2.5, "it got a quarter of one"
    assert process.passes(10, state="S", waited=1.0) == 2.5
    assert process.passes(10, state="D") == 2.5


def test_a_supervisor_that_was_asleep_counts_nothing(process: Process) -> None:
    process.pulse.feel(1, LATE_S + 100.0)
    assert process.pulse.still_s == 0.0


def test_who_is_under_a_debugger_does_not_hang_and_has_the_whole_time_afterwards(process: Process) -> None:
    process.passes(5, state="T")
    process.use = Use("t", 0.0, 0.0, traced=True)
    assert process.passes(60, state="t") == 0.0
    process.use = Use("T", 0.0, 0.0, traced=False)
    assert process.passes(3, state="T") == 3.0


def test_a_stopped_process_has_a_shorter_grace_than_one_that_may_go_on_by_itself(process: Process) -> None:
    process.passes(3, state="T")
    assert process.pulse.hangs(Grace())
    process.beat()
    process.passes(3, state="S")
    assert not process.pulse.hangs(Grace())
    process.passes(7, state="S")
    assert process.pulse.hangs(Grace())


def test_the_grace_for_debuggers_holds_for_a_stopped_process_too(process: Process) -> None:
    process.passes(60, state="T")
    assert not process.pulse.hangs(Grace(600.0, 600.0))


def test_where_there_is_no_proc_all_time_counts(process: Process) -> None:
    process.use = None
    assert process.passes(4) == 4.0


def test_a_loop_that_has_not_begun_to_beat_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "use_of", lambda _: Use("S", 0.0, 0.0, traced=False))
    pulse = Pulse()
    for _ in range(60):
        pulse.feel(1, 1.0)
    assert pulse.still_s == 0.0
    pulse.close()


def test_the_own_process_is_read_from_proc() -> None:
    use = use_of(os.getpid())
    assert use is not None
    assert use.state == "R"
    assert use.ran_s > 0.0
    assert not use.traced
    assert use_of(2**22 + 1) is None


def test_the_grace_is_a_number_of_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(GRACE, raising=False)
    assert grace() == Grace(HANGS_S, STOPPED_S)
    for text, times in (("600", Grace(600.0, 600.0)), ("0", Grace(0.0, 0.0)), ("", Grace())):
        monkeypatch.setenv(GRACE, text)
        assert grace() == times
    for text in ("long", "-1", "inf", "nan"):
        monkeypatch.setenv(GRACE, text)
        with pytest.raises(ConfigError, match=GRACE):
            grace()


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGUSR1], ids=["stopped", "loops for ever"])
def test_a_process_that_hangs_is_killed_and_restarted(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(GRACE, "1.5")
    with Shell(tmp_path) as shell:
        up = shell.start("up", shell.profile("loops", "good"))
        up.until("robbie is up")
        first, good = shell.pid("loops"), shell.pid("good")
        os.kill(first, number)
        assert "its event loop has not run for" in up.until("loops hangs: ")
        up.until("loops was killed by SIGKILL; restart in")
        up.until("loops ready in ")
        assert shell.pid("loops") != first
        assert shell.pid("good") == good
        assert up.end(signal.SIGINT) == 0


@pytest.mark.process
def test_a_grace_that_is_no_time_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(GRACE, "soon")
    with Shell(tmp_path) as shell:
        up = shell("up", shell.profile("good"))
        assert up.returncode == 2
        assert f"{GRACE} is 'soon'" in up.stdout
        detached = shell("up", shell.profile("good"), "--detach")
        assert detached.returncode == 2
        assert f"{GRACE} is 'soon'" in detached.stdout
