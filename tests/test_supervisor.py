"""`cocoro up`, `down` and `run`, with small components that become ready, crash, hang, or do not listen."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
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


def test_each_process_is_told_as_it_becomes_ready_and_all_stop_in_reverse_order(shell: Shell) -> None:
    up = shell.start("up", shell.profile("good", "pair"))
    up.until("robbie is up")
    assert any(line.startswith("good ready in ") for line in up.lines)
    assert any(line.startswith("pair (left, right) ready in ") for line in up.lines)
    assert {service: by.name for service, by in shell.run_dir.claims().items()} == {
        "good": "good", "left": "pair", "right": "pair",
    }  # fmt: skip
    assert up.end(signal.SIGINT) == 0
    assert [line for line in up.lines if line.endswith(" stopped")] == ["pair stopped", "good stopped"]
    assert shell.run_dir.claims() == {}
    assert "ended by a signal" in shell.run_dir.log("good").read_text()


def test_detached_it_stays_up_until_down_and_a_further_down_is_no_error(shell: Shell) -> None:
    up = shell("up", shell.profile("good"), "--detach")
    assert (up.returncode, up.stderr) == (0, "")
    assert up.stdout.splitlines()[-1] == "robbie is up (" + shell.profile("good") + ")"
    down = shell("down")
    assert (down.returncode, down.stdout) == (0, "robbie is down\n")
    again = shell("down")
    assert (again.returncode, again.stdout) == (0, "nothing was up\n")


def test_it_tells_the_robots_state_until_it_ends(shell: Shell) -> None:
    shell("up", shell.profile("good"), "--detach")
    assert shell.run_dir.survey_socket.is_socket()
    told = shell("status", "--json")
    assert (told.returncode, told.stderr) == (0, "")
    services = {one["service"]: one["state"] for one in json.loads(told.stdout)["services"]}
    assert services == {"good": "ready"}
    shell("down")
    assert not shell.run_dir.survey_socket.exists()
    assert shell("status").returncode == exits.NO_MESH


def test_a_crash_at_the_start_shows_the_logs_end_and_stops_everything(shell: Shell) -> None:
    up = shell("up", shell.profile("good", "dies"))
    assert up.returncode == 1
    assert "dies ended (exit code 1) at its start" in up.stdout
    assert "RuntimeError: the motor is on fire" in up.stdout
    assert "good stopped" in up.stdout
    assert shell.run_dir.claims() == {}
    detached = shell("up", shell.profile("good", "dies"), "--detach")
    assert detached.returncode == 1
    assert "RuntimeError: the motor is on fire" in detached.stdout


def test_a_mistake_in_the_profile_is_one_line_that_names_table_and_field(shell: Shell) -> None:
    profile = shell.profile("good", extra='[service.good]\npace_hz = "fast"\n')
    up = shell("up", profile)
    assert up.returncode == 2
    assert f"profile {profile}, [service.good]: pace_hz: Expected `float`, got `str`" in up.stdout
    assert "Traceback" not in up.stdout + up.stderr
    unknown = shell("up", shell.profile("good"), "--set", "service.good.pase_hz=2")
    assert unknown.returncode == 2
    assert "[service.good]: unknown field 'pase_hz'; known are pace_hz; did you mean pace_hz?" in unknown.stdout


def test_one_that_does_not_get_ready_in_time_is_named_with_what_is_missing(shell: Shell) -> None:
    up = shell("up", shell.profile("mute"))
    assert up.returncode == 1
    assert "mute was not ready after 0.5 s: no sign of mute" in up.stdout


def test_one_that_does_not_end_when_told_is_killed(shell: Shell) -> None:
    up = shell.start("up", shell.profile("good", "deaf"))
    up.until("robbie is up")
    assert up.end(signal.SIGTERM) == 0
    assert "deaf did not stop within 0.3 s: killed" in up.lines
    assert "good stopped" in up.lines
    assert shell.run_dir.claims() == {}


def test_a_killed_process_is_restarted_and_its_earlier_log_is_kept(shell: Shell) -> None:
    up = shell.start("up", shell.profile("good"))
    up.until("robbie is up")
    first = shell.pid("good")
    for wait in ("0.01", "0.02"):
        os.kill(shell.pid("good"), signal.SIGKILL)
        up.until(f"good was killed by SIGKILL; restart in {wait} s")
        up.until("good ready in ")
    assert shell.pid("good") != first
    assert (shell.run_dir.logs / "good.log.2").exists()
    assert up.end(signal.SIGINT) == 0


def test_one_that_is_never_restarted_leaves_the_others_running(shell: Shell) -> None:
    up = shell.start("up", shell.profile("once", "good"))
    up.until("robbie is up")
    os.kill(shell.pid("once"), signal.SIGTERM)
    up.until("once ended (exit code 0); it is not restarted")
    assert set(shell.run_dir.claims()) == {"good"}
    assert up.end(signal.SIGINT) == 0


def test_of_two_that_start_one_robot_at_once_one_is_refused(shell: Shell) -> None:
    profile = shell.profile("good")
    with ThreadPoolExecutor() as pool:
        results = list(pool.map(lambda _: shell("up", profile, "--detach"), range(2)))
    assert sorted(result.returncode for result in results) == [0, 3]
    refused = next(result for result in results if result.returncode == 3)
    assert "robbie is up already" in refused.stdout
    assert "cocoro down --robot robbie" in refused.stdout
    assert set(shell.run_dir.claims()) == {"good"}


def test_a_second_process_for_the_same_service_is_refused(shell: Shell) -> None:
    assert shell("up", shell.profile("pair"), "--detach").returncode == 0
    second = shell("run", "pair")
    assert second.returncode == 3
    assert f"robbie has a left already (pair, pid {shell.pid('left')})" in second.stderr
    assert "Traceback" not in second.stderr


def test_run_joins_the_robot_that_is_up_and_ends_with_ctrl_c(shell: Shell) -> None:
    assert shell("up", shell.profile("good"), "--detach").returncode == 0
    run = shell.start("run", "once")
    run.until("joined the mesh")
    assert run.end(signal.SIGINT) == 0
    assert run.lines[-1].endswith("once: ended by a signal")


def test_processes_do_not_outlive_a_killed_supervisor_and_the_robot_can_be_started_again(shell: Shell) -> None:
    up = shell.start("up", shell.profile("good", "deaf"))
    up.until("robbie is up")
    with closing(shell.target("good")) as good, closing(shell.target("deaf")) as deaf:
        assert good.pid is not None
        assert deaf.pid is not None
        assert up.end(signal.SIGKILL) == -signal.SIGKILL
        assert good.wait(PATIENCE_S)
        again = shell.start("up", shell.profile("good", "deaf"))
        assert deaf.wait(PATIENCE_S)  # it does not listen, but its watcher ends it
    again.until("robbie is up")
    assert again.end(signal.SIGINT) == 0


def test_down_ends_what_a_killed_supervisor_left(shell: Shell) -> None:
    up = shell.start("up", shell.profile("good"))
    up.until("robbie is up")
    with closing(shell.target("good")) as good:
        os.kill(good.pid or 0, signal.SIGSTOP)  # so that it cannot notice
        up.end(signal.SIGKILL)
        down = shell("down")
        assert (down.returncode, down.stdout) == (0, "robbie is down\n")
        assert good.wait(0.0)


def test_down_while_it_starts_ends_the_start(shell: Shell) -> None:
    up = shell.start("up", shell.profile("good", "slow"), "--detach")
    up.until("good ready in ")
    assert shell("down").stdout == "robbie is down\n"
    assert up.end() == 3
    assert shell.run_dir.claims() == {}
