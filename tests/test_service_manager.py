"""Notifications to systemd, and what its unit allows the robot to do."""

from __future__ import annotations

import asyncio
import os
import shlex
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from operator_shell import PATIENCE_S, Shell

from cocoro.bus import shared
from cocoro.vloop import run_virtual
from deploy import service_manager
from deploy.launch import ORPHAN_S

UNIT = Path(__file__).parents[1] / "deploy" / "systemd" / "cocoro@.service"
EXPOSED = 40
"""Upper bound for ten times the score of `systemd-analyze security`: 100 is no protection; without a sandbox it was
85."""


class Manager:
    """A service manager's socket."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.settimeout(PATIENCE_S)

    def hears(self) -> str:
        return self._socket.recv(4096).decode()

    def heard(self) -> list[str]:
        """Everything that was received."""
        found = []
        self._socket.setblocking(False)
        try:
            while True:
                found.append(self.hears())
        except BlockingIOError:
            return found
        finally:
            self._socket.settimeout(PATIENCE_S)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(short_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    manager = Manager(short_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(short_path / "notify"))
    yield manager
    manager.close()


async def petted(seconds: float, well: list[bool]) -> None:
    """Keep the watchdog for this long; `well` has the answer at each look, the last of them repeated."""
    looks = iter(well)
    now = [True]

    def look() -> bool:
        now[0] = next(looks, now[0])
        return now[0]

    with pytest.raises(TimeoutError):
        async with asyncio.timeout(seconds):
            await service_manager.keep_watchdog(look)


def test_the_watchdog_is_petted_thrice_a_period_while_all_is_well(
    manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    run_virtual(petted(9.5, [True]))
    assert manager.heard() == ["WATCHDOG=1"] * 10


def test_the_watchdog_is_not_petted_while_something_is_not_looked_after(
    manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    run_virtual(petted(9.5, [True, False, True, False]))
    assert manager.heard() == ["WATCHDOG=1"] * 2


@pytest.mark.parametrize(
    "environment", [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_USEC": "9", "WATCHDOG_PID": "1"}]
)
def test_where_nobody_watches_nothing_is_kept(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    run_virtual(service_manager.keep_watchdog(lambda: True))


@pytest.mark.process
@pytest.mark.zenoh
def test_a_supervisor_pets_the_watchdog_from_when_the_robot_is_up(
    manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "300000")
    with Shell(tmp_path) as shell:
        running = shell.start("up", shell.profile("good"))
        assert manager.hears() == "READY=1"
        for _ in range(3):
            assert manager.hears() == "WATCHDOG=1"
        assert running.end(2) == 0
    assert manager.heard()[-1] == "STOPPING=1"


# --- the unit -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unit() -> dict[str, list[str]]:
    """The unit's [Service] section: all values of each setting."""
    found: dict[str, list[str]] = {}
    section = ""
    for line in UNIT.read_text().splitlines():
        if line.startswith("["):
            section = line
        elif section == "[Service]" and "=" in line and not line.startswith("#"):
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
    return found


def test_the_unit_hides_nothing_that_the_emergency_stop_comes_over(unit: dict[str, list[str]]) -> None:
    """Abstract Unix sockets belong to the network namespace; /proc/net/unix lists them."""
    for name in ("PrivateNetwork", "NetworkNamespacePath", "JoinsNamespaceOf", "ProtectProc", "ProcSubset"):
        assert name not in unit, name
    assert "AF_UNIX" in unit["RestrictAddressFamilies"][0].split()
    assert {"AF_INET", "AF_INET6"} <= set(unit["RestrictAddressFamilies"][0].split())


def test_the_unit_lets_the_robot_do_its_work(unit: dict[str, list[str]]) -> None:
    for name in ("RuntimeDirectory", "StateDirectory", "LogsDirectory"):
        assert unit[name] == ["cocoro"]
    assert (unit["LimitRTPRIO"], unit["LimitNICE"]) == (["20"], ["-10"])
    assert "RestrictRealtime" not in unit
    assert "PrivateDevices" not in unit
    devices = {value.split()[0] for value in unit["DeviceAllow"]}
    assert {"char-ttyUSB", "char-ttyACM", "char-usb_device", "char-drm", "char-pts"} <= devices
    assert int(unit["LimitMEMLOCK"][0].removesuffix("M")) << 20 >= shared.LOCKED_BYTES
    assert int(unit["WatchdogSec"][0]) > 0


@pytest.mark.process
def test_the_unit_lets_processes_end_by_themselves_when_their_supervisor_has_died(unit: dict[str, list[str]]) -> None:
    """A Create would drive on if base service and guard were killed together."""
    assert unit["KillMode"] == ["mixed"]
    (after,) = unit["ExecStopPost"]
    command = shlex.split(after)[-1].replace("$$", "$").replace("sleep", "echo waits")
    for result, waits_s in (
        ("success", ""),
        ("watchdog", "6"),
        ("signal", "6"),
        ("core-dump", "6"),
        ("exit-code", "6"),
    ):
        environment = {"SERVICE_RESULT": result, "PATH": os.defpath}
        told = subprocess.run(["/bin/sh", "-c", command], env=environment, capture_output=True, text=True, check=True)
        assert told.stdout.split() == (["waits", waits_s] if waits_s else [])
        assert not waits_s or float(waits_s) > ORPHAN_S


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = shutil.which("systemd-analyze")
    if command is None:
        pytest.skip("there is no systemd-analyze here")
    return subprocess.run([command, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.process
def test_the_unit_is_not_exposed() -> None:
    if "--offline" not in analyze("security", "--help").stdout:
        pytest.skip("this systemd-analyze looks at no files")
    told = analyze("security", "--offline=true", f"--threshold={EXPOSED}", str(UNIT))
    assert told.returncode == 0, told.stdout


@pytest.mark.process
def test_the_unit_has_no_setting_that_systemd_does_not_know(tmp_path: Path) -> None:
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text().replace("/opt/cocoro/.venv/bin/cocoro", "/bin/true"))
    told = analyze("verify", "--man=no", str(copy))
    assert [line for line in told.stderr.splitlines() if UNIT.name.partition("@")[0] in line] == []
