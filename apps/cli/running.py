"""`up`, `down` and `run`: what starts and ends processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import IO, Any

import msgspec

from apps.cli import exits
from apps.cli.options import frames_of, latencies_of
from apps.cli.output import going_on
from cocoro import private
from cocoro.bus import shared
from cocoro.errors import CocoroError, ConfigError
from deploy import launch, profiles
from deploy.profiles import Profile
from deploy.rundir import RunDir, Target, robots, targets

ERRORS = "supervisor.err"
ERRORS_BYTES = 64 * 1024
STOP_S = 60.0
"""How long a supervisor may take to stop everything."""


def overrides(
    scene: str | None,
    seed: int | None,
    sensors: str | None,
    body: str | None,
    frames: str | None,
    latency: list[str],
    settings: list[str],
) -> list[str]:
    """The options of `up` as settings of the profile. Raises ConfigError."""
    sim: dict[str, Any] = {}
    if scene is not None:
        sim["scene"] = scene_of(scene)
    if seed is not None:
        sim["seed"] = seed
    if sensors is not None:
        sim["sensors"] = sensors
    if body is not None:
        sim["body"] = body
    if frames is not None:
        sim.update(frames_of(frames))
    found = [f"service.sim.{name}={json.dumps(value)}" for name, value in sim.items()]  # JSON's values are TOML's here
    found += [f"service.{name}.latency_s={seconds}" for name, seconds in latencies_of(latency).items()]
    return found + settings


def objects_of(file: Path) -> str:
    """A file of known objects as a setting of the profile; read once here, so that a mistake in it is said at once."""
    from cocoro.objects import Catalogue

    Catalogue.load(file)
    return f"objects={json.dumps(str(file.resolve()))}"


def model_of(file: Path | None, reach: str | None, adapt: bool = False) -> list[str]:
    """A learned model, whether to reach with it, and whether to go on teaching it, as settings of the profile. Raises
    ConfigError."""
    if file is not None and not file.is_file():
        raise ConfigError(f"there is no model {file}")
    found = [] if file is None else [f"service.planning.model={json.dumps(str(file.resolve()))}"]
    found += [] if reach is None else [f"service.planning.reach={json.dumps(reach)}"]
    return found + (["service.planning.adapt=true"] if adapt else [])


def scene_of(scene: str) -> str:
    """A scene's name as it is; a file's name so that it means the same file from anywhere."""
    if not scene.endswith(".toml") and os.sep not in scene:
        return scene
    if not Path(scene).is_file():
        raise ConfigError(f"there is no scene file {scene}")
    return str(Path(scene).resolve())


def up(profile: Profile, unattended: bool) -> int:
    """Supervise a robot in the foreground."""
    run_dir = RunDir(profile.robot)
    from deploy import supervisor  # takes its time to import, and `up --detach` has no need of it

    return supervisor.supervise(profile, run_dir, _say, lambda: _say("Ctrl-C stops it"), by_hand=not unattended)


def up_detached(profile: Profile, unattended: bool) -> int:
    """Start a supervisor of its own, and return when the robot is up or could not be started."""
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
                    _say(report["line"])
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
    """Where a supervisor writes what it could not say otherwise; nowhere where nothing can be written."""
    try:
        return os.fdopen(private.open_file(run_dir.logs / ERRORS, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), "wb")
    except private.FullError:
        return os.fdopen(os.open(os.devnull, os.O_WRONLY), "wb")


def _last_error(run_dir: RunDir) -> str:
    """What a supervisor wrote last, to be put after a sentence."""
    try:
        lines = private.read(run_dir.logs / ERRORS, ERRORS_BYTES).decode(errors="replace").splitlines()
    except (FileNotFoundError, CocoroError):
        return ""
    return f"{f': {lines[-1]}' if lines else ''}; see {run_dir.logs / ERRORS}"


def down(robot: str | None) -> int:
    """Stop one robot, or all that are up on this machine."""
    chosen = [RunDir(robot)] if robot is not None else [r for r in robots() if r.supervisor() or r.claims()]
    stopped = [_stop(run_dir) for run_dir in chosen]
    shared.sweep()  # what killed processes left
    if not any(stopped):
        _say(f"{robot or 'nothing'} was not up" if robot else "nothing was up")
    return exits.DONE


def _stop(run_dir: RunDir) -> bool:
    """Whether there was something to stop."""
    found = False
    with closing(Target(run_dir.path / "supervisor")) as supervisor:
        if supervisor.pid is not None:
            found = True
            supervisor.signal(signal.SIGTERM)
            if not supervisor.wait(STOP_S):
                _say(f"{run_dir.robot}: the supervisor (pid {supervisor.pid}) does not end: killed")
                supervisor.signal(signal.SIGKILL)
                supervisor.wait(STOP_S)
    for target in targets(run_dir):  # what a killed supervisor left, or was started by `run`
        with closing(target):
            found = found or target.pid is not None
            target.signal(signal.SIGTERM)
            target.signal(signal.SIGCONT)  # a stopped process could not obey
            if not target.wait(launch.ORPHAN_S):
                target.signal(signal.SIGKILL)
                target.wait(launch.ORPHAN_S)
    if found:
        _say(f"{run_dir.robot} is down")
    return found


def run(process: str, profile: str | None, settings: list[str]) -> int:
    """One process in the foreground."""
    if profile is None and not settings and (up_here := robots()):
        if len(up_here) > 1:
            raise ConfigError(f"several robots are up ({', '.join(r.robot for r in up_here)}): say --profile")
        data = up_here[0].resolved()
        read = profiles.from_data(data, data.get("name", "")) if data else profiles.read("sim")
    else:
        read = profiles.read(profile or "sim", settings)
    run_dir = RunDir(read.robot)
    run_dir.make()
    launch.set_up_logging(process)
    with going_on():
        return launch.run(process, run_dir, msgspec.to_builtins(read), read.name, raise_crashes=True)


def _say(text: str) -> None:
    with going_on():  # when nobody reads any more, as with `cocoro up | head`, the robot must not mind
        print(text, flush=True)
