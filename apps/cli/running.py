"""`cocoro up`, `down` and `run`: start and stop a robot's processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import IO, Annotated, Any, TextIO

import msgspec
import typer

from apps.captures.names import open_captures
from apps.cli import completions, exits
from apps.cli.options import (
    AdaptOption,
    AnyRobotOption,
    FramesOption,
    JsonOption,
    LatencyOption,
    ModelOption,
    ObjectsOption,
    ReachOption,
    RobotOption,
    SceneOption,
    SetOption,
    SiteOption,
    frames_of,
    latencies_of,
    name_option,
    one_of,
    scene_of,
)
from apps.cli.output import going_on, print_json
from cocoro import private
from cocoro.bus import shared
from cocoro.errors import CocoroError, ConfigError
from deploy import extras, launch, profiles
from deploy.profiles import Profile
from deploy.rundir import RunDir, Target, robots, targets
from deploy.which_robot import only, profile_of, up_here
from services.cockpit.component import COCKPIT

SENSORS, BODIES, REACHES = ("ideal", "real"), ("nominal", "worn"), ("learned", "rigid")
ERRORS = "supervisor.err"
ERRORS_BYTES = 64 * 1024
STOP_S = 60.0
"""Longest wait for a supervisor to stop everything."""


app = typer.Typer()


@app.command()
def up(
    profile: Annotated[
        str | None,
        typer.Argument(
            help="A profile's name (sim, robot, sim-wire, lekiwi-wire, replay) or file; sim by default.",
            autocompletion=completions.profiles,
        ),
    ] = None,
    robot: AnyRobotOption = None,
    detach: Annotated[bool, typer.Option("--detach", "-d", help="Return when the robot is up.")] = False,
    scene: SceneOption = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Simulator: seed of all random numbers.")] = None,
    sensors: Annotated[
        str | None,
        name_option(*SENSORS, help="Simulator: sensors without or with errors."),
    ] = None,
    body: Annotated[
        str | None,
        name_option(*BODIES, help="Simulator: a body that equals the nominal model, or differs."),
    ] = None,
    model: ModelOption = None,
    reach: ReachOption = None,
    adapt: AdaptOption = False,
    frames: FramesOption = None,
    latency: LatencyOption = None,
    objects: ObjectsOption = None,
    set_: SetOption = None,
    unattended: Annotated[
        bool,
        typer.Option("--unattended", help="No person is present: the robot's first start has the emergency stop set."),
    ] = False,
    no_cockpit: Annotated[bool, typer.Option("--no-cockpit", help="Without the page in the browser.")] = False,
    site: SiteOption = None,
    host: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Start the share of this host of the site, and its gateway."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Start a robot's processes and stay until Ctrl-C (or, with --detach, until they are ready)."""
    settings = overrides(scene, seed, sensors, body, frames, latency or [], set_ or [])
    if objects is not None:
        settings.insert(0, objects_of(objects))
    settings[:0] = model_of(model, reach, adapt)
    if host is None:
        read = profile_of(profile or "sim", robot, overrides=settings)
    else:
        read = share_of(profile, site, host, settings, robot)
    if no_cockpit:
        read = without_cockpit(read)
    extras.require(f"cocoro up {profile or ''}".strip(), read.rows())
    if json and not detach:
        raise ConfigError("--json says when the robot is up, so it needs --detach")
    if not detach:
        sys.exit(supervise(read, unattended))
    code = supervise_detached(read, unattended, sys.stderr if json else sys.stdout)
    if json and code == exits.DONE:
        print_json({"robot": read.robot, "profile": read.name, "up": True, "services": read.services()})
    sys.exit(code)


@app.command()
def down(robot: RobotOption = None, json: JsonOption = False) -> None:
    """Stop a robot's processes. It is no error when none run."""
    sys.exit(stop_robots(robot, json))


@app.command()
def run(
    process: Annotated[
        str,
        typer.Argument(
            help="A process of the profile, or any other that is installed.", autocompletion=completions.processes
        ),
    ],
    profile: Annotated[
        str | None,
        typer.Option(
            metavar="PROFILE",
            autocompletion=completions.profiles,
            help="By default that of the robot that is up here, else sim.",
        ),
    ] = None,
    robot: AnyRobotOption = None,
    set_: SetOption = None,
) -> None:
    """Run one process in this terminal, on the mesh of the profile. Ctrl-C ends it."""
    sys.exit(run_process(process, profile, set_ or [], robot))


def without_cockpit(profile: Profile) -> Profile:
    """The profile without the process that serves the page. Raises ConfigError where nothing else is in it."""
    left = tuple(name for name in profile.processes if name != COCKPIT.name)
    if not left:
        raise ConfigError(f"--no-cockpit: profile {profile.name} starts nothing else")
    return msgspec.structs.replace(profile, processes=left)


def share_of(
    profile: str | None, site: Path | None, host: str, settings: list[str], robot: str | None = None
) -> Profile:
    """The profile of a host's share. Raises ConfigError for a profile or a robot that is named beside, or a site that
    cannot be used."""
    from deploy.site import place, plan

    if profile is not None:
        raise ConfigError(f"--host {host}: its robot's profile is in the site's plan; leave {profile} out")
    if robot is not None:
        raise ConfigError(f"--host {host}: its robot is in the site's plan; leave --robot {robot} out")
    return plan.read(place.folder(site)).share_profile(host, settings)


# --- options as settings of the profile -------------------------------------------------------------


def overrides(
    scene: str | None,
    seed: int | None,
    sensors: str | None,
    body: str | None,
    frames: str | None,
    latency: list[str],
    settings: list[str],
) -> list[str]:
    """The options of `up` as settings of the profile, KEY=VALUE. Raises ConfigError for an unreadable option."""
    sim: dict[str, Any] = {}
    if scene is not None:
        sim["scene"] = scene_of(scene)
    if seed is not None:
        sim["seed"] = seed
    if sensors is not None:
        sim["sensors"] = one_of("--sensors", sensors, SENSORS)
    if body is not None:
        sim["body"] = one_of("--body", body, BODIES)
    if frames is not None:
        sim.update(frames_of(frames))
    # These JSON values are TOML values, too.
    found = [f"service.sim.{name}={json.dumps(value)}" for name, value in sim.items()]
    found += [f"service.{name}.latency_s={seconds}" for name, seconds in latencies_of(latency).items()]
    return found + settings


def objects_of(file: Path) -> str:
    """A file of known objects as a setting of the profile. Reads it, so that a mistake in it is reported here."""
    from cocoro.objects import Catalogue

    Catalogue.load(file)
    return f"objects={json.dumps(str(file.resolve()))}"


def model_of(file: Path | None, reach: str | None, adapt: bool = False) -> list[str]:
    """`--model`, `--reach` and `--adapt` as settings of the profile. Raises ConfigError for a missing model file."""
    if file is not None and not file.is_file():
        raise ConfigError(f"--model {file}: no such file; `cocoro learn` writes one")
    found = [] if file is None else [f"service.planning.model={json.dumps(str(file.resolve()))}"]
    found += [] if reach is None else [f"service.planning.reach={json.dumps(one_of('--reach', reach, REACHES))}"]
    return found + (["service.planning.adapt=true"] if adapt else [])


# --- up -------------------------------------------------------------------------------------------


def supervise(profile: Profile, unattended: bool) -> int:
    """Supervises a robot in the foreground until Ctrl-C; returns the exit code."""
    run_dir = RunDir(profile.robot)
    from deploy import supervisor  # slow to import; `up --detach` does not need it

    return supervisor.supervise(profile, run_dir, _print, lambda: _print("Ctrl-C stops it"), by_hand=not unattended)


def supervise_detached(profile: Profile, unattended: bool, out: TextIO | None = None) -> int:
    """Starts a supervisor in a session of its own; returns when the robot is up, or with the exit code of its failure.

    Raises CocoroError when the supervisor dies.
    """
    run_dir = RunDir(profile.robot)
    run_dir.make()
    reader_fd, writer_fd = os.pipe()
    command = [
        sys.executable,
        "-P",
        "-m",
        "deploy.supervisor",
        "--run-dir",
        str(run_dir.path),
        "--report-fd",
        str(writer_fd),
    ]
    with _errors_file(run_dir) as stderr:
        process = subprocess.Popen(
            command + ["--unattended"] * unattended,
            stdin=subprocess.PIPE,
            stdout=stderr,
            stderr=stderr,
            pass_fds=(writer_fd,),
            start_new_session=True,
        )
    os.close(writer_fd)
    assert process.stdin is not None
    with process.stdin as stdin:
        stdin.write(msgspec.json.encode(profile))
    code = None
    with os.fdopen(reader_fd) as reports:
        try:
            for report in map(json.loads, reports):
                if "line" in report:
                    _print(report["line"], out)
                else:
                    code = report["code"]
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            process.wait()
            return exits.REFUSED
    if code is None:
        process.wait()
        raise CocoroError(f"the supervisor died{_last_error(run_dir)}")
    if code != exits.DONE:
        process.wait()
    return int(code)


def _errors_file(run_dir: RunDir) -> IO[bytes]:
    """The file for a supervisor's standard error; /dev/null when the run directory's disk is full."""
    try:
        return os.fdopen(private.open_file(run_dir.logs / ERRORS, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), "wb")
    except private.FullError:
        return os.fdopen(os.open(os.devnull, os.O_WRONLY), "wb")


def _last_error(run_dir: RunDir) -> str:
    """The last line that the supervisor wrote, with the file's name, to be appended to a sentence."""
    try:
        lines = private.read(run_dir.logs / ERRORS, ERRORS_BYTES).decode(errors="replace").splitlines()
    except (FileNotFoundError, CocoroError):
        return ""
    return f"{f': {lines[-1]}' if lines else ''}; see {run_dir.logs / ERRORS}"


# --- down and run -----------------------------------------------------------------------------------


def stop_robots(robot: str | None, as_json: bool = False) -> int:
    """Stops one robot, or all that are up on this machine; returns the exit code."""
    chosen = [up_here(robot)] if robot is not None else [r for r in robots() if r.supervisor() or r.claims()]
    stopped = [run_dir.robot for run_dir in chosen if _stop(run_dir, as_json)]
    shared.sweep()  # shared memory that killed processes left
    if as_json:
        print_json({"down": stopped})
    elif not stopped:
        _print(f"{robot} was not up" if robot else "nothing was up")
    return exits.DONE


def _stop(run_dir: RunDir, quiet: bool = False) -> bool:
    """Stops one robot; returns whether anything was running."""
    found = False
    recorded = open_captures(run_dir)
    with closing(Target(run_dir.path / "supervisor")) as supervisor:
        if supervisor.pid is not None:
            found = True
            supervisor.signal(signal.SIGTERM)
            if not supervisor.wait(STOP_S):
                _print(f"{run_dir.robot}: the supervisor (pid {supervisor.pid}) does not end; killing it")
                supervisor.signal(signal.SIGKILL)
                supervisor.wait(STOP_S)
    for target in targets(run_dir):  # left by a killed supervisor, or started by `run`
        with closing(target):
            found = found or target.pid is not None
            target.signal(signal.SIGTERM)
            target.signal(signal.SIGCONT)  # a stopped process handles no signal
            if not target.wait(launch.ORPHAN_S):
                target.signal(signal.SIGKILL)
                target.wait(launch.ORPHAN_S)
    if found and not quiet:
        _print(f"{run_dir.robot} is down")
        for path in filter(Path.exists, recorded):
            _print(f"recorded in {path}")
    return found


def run_process(process: str, profile: str | None, settings: list[str], robot: str | None = None) -> int:
    """Runs one process in the foreground; returns its exit code. Raises ConfigError when the profile is not clear."""
    running = [] if profile is not None or settings else [one for one in robots() if robot in (None, one.robot)]
    if running:
        data = only(running).resolved()
        read = profiles.from_data(data, data.get("name", "")) if data else profiles.read("sim")
    else:
        read = profile_of(profile or "sim", robot, overrides=settings)
    run_dir = RunDir(read.robot)
    run_dir.make()
    launch.set_up_logging(process)
    with going_on():
        return launch.run(process, run_dir, msgspec.to_builtins(read), read.name, raise_crashes=True)


def _print(text: str, out: TextIO | None = None) -> None:
    with going_on():  # a closed standard output, as in `cocoro up | head`, must not stop the robot
        print(text, file=out, flush=True)
