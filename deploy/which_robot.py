"""Which robot `--robot NAME|FILE` means, in every command.

A name is that of a robot that is up on this machine, else of one whose description the project ships. A file is a
robot description. A command on a mesh is for the robot that is up under that name, or that was started with that file.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from cocoro.description import SHIPPED, is_shipped
from cocoro.errors import CocoroError, ConfigError, MeshError, choice_of
from cocoro.robot_files import RobotFiles, objects_beside
from deploy import profiles
from deploy.profiles import Profile
from deploy.rundir import START, RunDir, robots


def files_of(given: str | None) -> RobotFiles:
    """The files of a robot that need not be up; None is the Calliope. Raises ConfigError for an unknown name, and for a
    file that is no robot description."""
    if given is None:
        return RobotFiles()
    if _is_file(given):
        return _described_in(given)
    for run_dir in _up():
        if run_dir.robot == given:
            return started_with(run_dir)
    if is_shipped(given):
        return RobotFiles(given, Path(given), objects=objects_beside(given))
    if Path(given).is_dir():
        raise ConfigError(f"--robot {given}: that is a folder; give the description in it: {Path(given) / given}.toml")
    known = [*SHIPPED, *(run_dir.robot for run_dir in _up())]
    raise ConfigError(f"--robot {given}: {choice_of(given, known)}; or give the .toml file of its description")


def files_here(given: str | None) -> RobotFiles:
    """As `files_of`; without a name or a file, the robot that is up on this machine, else the Calliope. Raises
    ConfigError when several are up, too."""
    if given is None and (up := _up()):
        return started_with(only(up))
    return files_of(given)


def profile_of(which: str, given: str | None, measured: Path | None = None, overrides: Iterable[str] = ()) -> Profile:
    """The profile `which` of the robot that `--robot` gives; of its own without. Raises ConfigError as `files_of` and
    `profiles.read` do."""
    return profiles.read(which, overrides, None if given is None else files_of(given), measured)


def up_here(given: str) -> RunDir:
    """The folder of the robot of that name, up or not, or of the one that is up with that description. Raises
    ConfigError when several are, MeshError when none is."""
    if not _is_file(given):
        return RunDir(given)
    path, up = str(Path(given).resolve()), robots()
    its = [run_dir for run_dir in up if run_dir.resolved().get("description") == path]
    if not its:
        advice = f"up here: {', '.join(run_dir.robot for run_dir in up)}" if up else START
        raise MeshError(f"no robot with the description {given} is up on this machine: {advice}")
    return only(its)


def only(up: list[RunDir]) -> RunDir:
    """The one of these robots. Raises ConfigError when there are several."""
    if len(up) > 1:
        raise ConfigError(f"several robots are up; choose one: {', '.join(f'--robot {r.robot}' for r in up)}")
    return up[0]


def _is_file(given: str) -> bool:
    return os.sep in given or given.endswith(".toml")


def _up() -> list[RunDir]:
    """Robots that are up here; none where the run directory cannot be used."""
    with suppress(CocoroError):
        return robots()
    return []


def started_with(run_dir: RunDir) -> RobotFiles:
    """The files of a robot's last start on this machine; the Calliope's where there was none."""
    resolved = run_dir.resolved()
    description, measured, objects = (
        Path(file) if isinstance(file := resolved.get(name), str) else None
        for name in ("description", "measured", "objects")
    )
    return RobotFiles(run_dir.robot, description, measured, objects)


def _described_in(given: str) -> RobotFiles:
    path = Path(given)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        known = ", ".join(SHIPPED)
        raise ConfigError(f"--robot {given}: no such file; give a robot description, or a name: {known}") from None
    except OSError as error:
        raise ConfigError(f"--robot {given}: {error.strerror}; give the .toml file of a robot description") from error
    except ValueError as error:  # not UTF-8, not TOML, no path
        raise ConfigError(f"--robot {given}: {error}") from error
    if "processes" in data:
        its = data.get("description")
        where = path.parent / its if isinstance(its, str) and not is_shipped(its) else its or "calliope"
        raise ConfigError(f"--robot {given}: that is a profile; give the description of its robot: --robot {where}")
    name = data.get("name")
    file = path.resolve()
    return RobotFiles(name if isinstance(name, str) else path.stem, file, objects=objects_beside(file))
