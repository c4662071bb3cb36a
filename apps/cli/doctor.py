"""`cocoro doctor`: checks of the machine and of the robot's hardware before a run."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from datetime import UTC, datetime
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import typer

from apps.cli import exits
from apps.cli.options import AnyRobotOption, JsonOption, MeasuredOption, ProfileArgument
from apps.cli.output import print_json
from apps.cli.terminal import folded
from cocoro.bus import shared
from cocoro.checks import Check, bad, note, ok
from cocoro.component import Component, load, machine_checks
from cocoro.errors import ConfigError
from cocoro.held_file import Holder
from cocoro.robot import Robot
from cocoro.stop.asking import addresses
from cocoro.stop.path import StopPoint
from cocoro.stop.record import latch_dir, read
from deploy import extras
from deploy.processes import shared_bytes
from deploy.profiles import Profile
from deploy.rundir import RunDir
from deploy.site import place
from deploy.which_robot import profile_of

RULES = Path("/etc/udev/rules.d/99-cocoro.rules")
ENOUGH_GB = 1.0
"""Free disk space below this is a problem."""
MARKS = {"ok": "ok  ", "note": "note", "bad": "BAD "}
SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
EARLIEST_S = 1_700_000_000
"""A wall clock before this time (end of 2023) is wrong."""
IN_MEMORY = ("tmpfs", "ramfs")
"""File systems that a reboot empties."""

app = typer.Typer()


@app.command()
def doctor(
    profile: ProfileArgument = "robot",
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
    json: JsonOption = False,
) -> None:
    """Check a machine and its robot before a run; each line is well, or says what to do. Exit code 1 if not."""
    sys.exit(print_checks(profile, json, robot, measured))


def print_checks(profile_name: str, as_json: bool, robot: str | None = None, measured: Path | None = None) -> int:
    """Prints all checks of a profile; the exit code is 1 when one found a problem."""
    profile = profile_of(profile_name, robot, measured)
    checks = list(examine(profile))
    if as_json:
        print_json([check._asdict() for check in checks])
    else:
        width = max(len(check.name) for check in checks)
        for check in checks:
            print(*folded(f"{MARKS[check.state]}  {check.name:<{width}}  ", check.text), sep="\n")
    return exits.FAILED if any(check.state == "bad" for check in checks) else exits.DONE


def examine(profile: Profile) -> Iterator[Check]:
    """All checks that apply to a profile."""
    run_dir = RunDir(profile.robot)
    yield from _libraries(profile)
    robot, own = _robot(profile)
    if own is not None:
        yield own
    if profile.clock == "real":
        yield _rules()
        yield from _priority()
    claims: dict[str, Holder] = {}
    try:
        claims = run_dir.claims()
    except ConfigError as error:
        yield bad("robot's folder", str(error))
    for row in profile.rows():
        running = [service for service in row.services if service in claims]
        if running:
            yield note(row.name, f"runs (pid {claims[running[0]].pid}): `cocoro status` shows its state")
        elif not any(extras.missing([row])):  # its checks need them
            yield from _own_checks(row, profile, robot)
    yield _clock(profile)
    yield _shared_memory(profile, claims)
    yield from _disk(run_dir)
    yield from stop_checks(profile.robot)
    yield from _site()


def _robot(profile: Profile) -> tuple[Robot, Check | None]:
    """The robot's description, and a check of its files."""
    try:
        robot = Robot.load(*profile.robot_files)
    except ConfigError as error:
        return Robot.load(), bad("robot's files", str(error))
    if profile.measured is not None:
        return robot, ok("robot's own file", profile.measured)
    if profile.clock == "real":
        what = "none: zeros and limits are nominal; `cocoro servos calibrate` measures them"
        return robot, note("robot's own file", what)
    return robot, None


def _libraries(profile: Profile) -> Iterator[Check]:
    rows = profile.rows()
    lacking = set(extras.missing(rows))
    for name in dict.fromkeys(library for row in rows for library in row.libraries):
        if name in lacking:
            yield bad(name, f"is not installed: {extras.advice(name)}")
        else:
            yield ok(name, _version(name))


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:  # another distribution has the module, as opencv-python does
        return "installed"


def _own_checks(component: Component, profile: Profile, robot: Robot) -> Iterable[Check]:
    """Whether the component's implementation is installed, and the checks that it declares."""
    if not _exists(component.module):
        return (bad(component.name, f"there is no module {component.module}: install the package that has it"),)
    if not component.checks:
        return ()
    config = profile.config(component.name, load(component).config)
    return machine_checks(component, config, robot, profile.robot)


def _exists(module: str) -> bool:
    """Whether a module is installed; only the packages that it lies in are imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _shipped(*path: str) -> str:
    """The path of a file that comes with the project, wherever it is installed."""
    return str(resources.files("deploy").joinpath(*path))


def _rules() -> Check:
    if RULES.exists():
        return ok("udev rules", str(RULES))
    return bad("udev rules", f"not installed: sudo cp {_shipped('udev', RULES.name)} {RULES.parent}, then replug")


def _priority() -> Iterator[Check]:
    """Whether the base's guard may run at real-time priority."""
    import resource

    allowed = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] > 0
    if allowed:
        yield ok("real-time priority", "allowed")
    else:
        unit = _shipped("systemd", "cocoro@.service")
        yield note("real-time priority", f"not allowed: LimitRTPRIO and LimitNICE in the unit file allow it ({unit})")


def _clock(profile: Profile) -> Check:
    if time.time() < EARLIEST_S:
        return bad("clock", f"it shows {time.strftime('%Y')}, which is wrong: set it, or enable systemd-timesyncd")
    if place.found() is not None and not SYNCHRONISED.exists():
        return note("clock", "not known to be synchronised; the clocks of a robot's machines must agree to 0.1 s")
    return ok("clock", time.strftime("%Y-%m-%d %H:%M:%S"))


def _shared_memory(profile: Profile, claims: Mapping[str, Holder]) -> Check:
    """Whether there is shared memory for the frames; without it they are copied."""
    rows = profile.rows()
    wanted_bytes = shared_bytes(rows)
    if any(row.frames == "publishes" and set(row.services) & set(claims) for row in rows):
        return ok("shared memory", f"{sum(shared.segments().values()) / 1e6:.1f} MB in use")
    if why := shared.obstacle(wanted_bytes):
        return note("shared memory", f"{why}; until then {shared.COSTS}")
    return ok("shared memory", f"enough for the {wanted_bytes / 1e6:.1f} MB of the frames")


def _disk(run_dir: RunDir) -> Iterator[Check]:
    for what, path in (("run directory", run_dir.root), ("logs", run_dir.logs)):
        there = next(folder for folder in (path, *path.parents) if folder.exists())
        if not os.access(there, os.W_OK):
            yield bad(what, f"{there} is not writable; set COCORO_RUN_DIR or COCORO_LOG_DIR to another directory")
            continue
        free_gb = shutil.disk_usage(there).free / 1e9
        text = f"{path}, {free_gb:.1f} GB free"
        yield ok(what, text) if free_gb >= ENOUGH_GB else bad(what, f"{text}: free some space")


def _site() -> Iterator[Check]:
    """Whether the site's certificates are in order; nothing where no site is set."""
    site = place.found()
    if site is None:
        return
    from deploy.site.checks import certificate_checks

    yield from certificate_checks(site, datetime.now(UTC))


# --- the emergency stop -----------------------------------------------------------------------------


def stop_checks(robot: str) -> Iterator[Check]:
    """Whether the stop path works, and where the latch is kept."""
    yield _stop_path()
    yield _latch(robot)


def _stop_path() -> Check:
    """Opens a stop point as a service does, and looks for it as `cocoro stop` does."""
    name = f"doctor-{os.getpid()}"
    try:
        with closing(StopPoint(name, "doctor")):
            found = addresses(name)
    except OSError as error:
        return bad("emergency stop", f"the stop path does not work ({error}): is /proc mounted?")
    if not found:
        return bad(
            "emergency stop", "its addresses are missing in /proc/net/unix, so `cocoro stop` would not find them"
        )
    return ok("emergency stop", "the stop path works; every user of this machine may stop the robot")


def _latch(robot: str) -> Check:
    folder = latch_dir(robot)
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        return bad(
            "its latch",
            f"{there} cannot be written, so the robot starts stopped; set COCORO_STATE_DIR",
        )
    if (kind := _filesystem(there)) in IN_MEMORY:
        return bad(
            "its latch",
            f"{folder} is in memory ({kind}) and does not survive a reboot; set COCORO_STATE_DIR",
        )
    latched = (
        [latch for file in sorted(folder.glob("[!.]*")) if (latch := read(file)).latched] if folder.is_dir() else []
    )
    if latched:
        return note("its latch", f"latched by {latched[0].by}; `cocoro reset` releases it when the robot is up")
    return ok("its latch", f"kept in {folder}")


def _filesystem(path: Path) -> str:
    """Type of the file system that holds a path; empty where /proc does not list it."""
    try:
        mounts = [line.split() for line in Path("/proc/self/mounts").read_text(errors="replace").splitlines()]
    except OSError:
        return ""
    place = str(path.resolve())
    over = [(row[1], row[2]) for row in mounts if place == row[1] or place.startswith(row[1].rstrip("/") + "/")]
    return max(over, key=lambda row: len(row[0]), default=("", ""))[1]
