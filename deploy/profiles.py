"""Profiles: TOML files that name a robot, its processes, their settings and their mesh.

robot = "calliope"
clock = "sim"                     # or "real"
processes = ["sim", "perception", "planning", "executive"]
objects = "objects.toml"          # known objects instead of the project's own; relative to this file

[mesh]                            # see deploy.mesh_table.Mesh; it may be left out
[service.sim]                     # the settings of that component, and for any component:
latency_s = 0.0                   #   added to every step, as if its computation took longer
record_steps = false              #   publish the inputs and outputs of each step
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from cocoro.component import Component
from cocoro.description import SHIPPED, is_shipped
from cocoro.errors import ConfigError, choice_of, field_text
from cocoro.robot_files import RobotFiles, objects_beside, scene_beside
from deploy.mesh_table import Mesh
from deploy.processes import named, needs
from deploy.site.component import PREFIX
from sim.component import SIM
from sim.scene_names import DEFAULT

C = TypeVar("C")
_PATTERN = r"\A[a-z0-9][a-z0-9_-]{0,31}\Z"
Name = Annotated[str, Meta(pattern=_PATTERN)]
"""A chunk of a key, and the name of a directory."""
A_NAME = "a name has 1 to 32 small letters, digits, '-' and '_', and begins with a letter or a digit"

SIMULATOR = SIM.name
PACKAGE = "deploy"
"""The package whose resources contain the project's profiles."""


class Launch(msgspec.Struct, frozen=True, kw_only=True):
    """Settings that every `[service.NAME]` table may have besides those of its component."""

    latency_s: Annotated[float, Meta(ge=0, le=60)] = 0.0
    record_steps: bool = False


class Profile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A resolved profile: overrides applied, paths absolute, names checked. `read` makes it."""

    name: str = ""
    """Its name or path, for error messages; not part of the file."""
    robot: Name
    clock: Literal["sim", "real"] = "real"
    processes: Annotated[tuple[Name, ...], Meta(min_length=1)]
    """The components that are started, in this order; they are stopped in reverse order."""
    description: str | None = None
    """A robot description file instead of the Calliope's, or the name of a robot that the project ships."""
    measured: str | None = None
    """A file of values measured on this robot; they override the description."""
    objects: str | None = None
    """A file of known objects instead of the project's own, for every component with a setting `objects`."""
    mesh: Mesh = Mesh()
    service: dict[Name, dict[str, Any]] = {}

    @property
    def robot_files(self) -> tuple[Path | None, Path | None]:
        """The description and the measured file, as `Robot.load` takes them."""
        description, measured = (None if file is None else Path(file) for file in (self.description, self.measured))
        return description, measured

    def of_robot(self, files: RobotFiles) -> Profile:
        """A profile like this one for another robot. What was measured on this one goes, unless the other has the same
        description. Raises ConfigError for a name that a mesh cannot have."""
        if not re.fullmatch(_PATTERN, files.name):
            raise ConfigError(f"robot description {files.description}: name = {files.name!r}: {A_NAME}")
        description = None if files.description is None else _kept(files.description)
        same = (description or SHIPPED[0]) == (self.description or SHIPPED[0])
        return msgspec.structs.replace(
            self,
            robot=files.name,
            description=description,
            measured=str(files.measured) if files.measured is not None else self.measured if same else None,
            objects=self.objects or (None if files.objects is None else str(files.objects)),
        )

    def with_own_files(self) -> Profile:
        """A profile like this one with what lies beside the description where the profile names nothing else: the
        robot's known objects, and its own scene of the name that the simulator's settings have."""
        objects = self.objects or objects_beside(self.description)
        made = msgspec.structs.replace(self, objects=None if objects is None else str(objects))
        if not any(row.settings == SIMULATOR or row.name == SIMULATOR for row in self.rows()):
            return made
        table = self.service.get(SIMULATOR, {})
        scene = scene_beside(self.description, str(table.get("scene", DEFAULT)))
        if scene is None:
            return made
        return msgspec.structs.replace(made, service={**self.service, SIMULATOR: {**table, "scene": str(scene)}})

    def rows(self) -> tuple[Component, ...]:
        """The components. Raises ConfigError for an unknown one."""
        return tuple(named(name) for name in self.processes)

    def services(self) -> tuple[str, ...]:
        """The services that are alive when all components are ready."""
        return tuple(service for row in self.rows() for service in row.services)

    @property
    def shared(self) -> bool:
        """Whether this is one host's share of a robot, joined with others by a gateway."""
        return any(name.startswith(PREFIX) for name in self.processes)

    def launch(self, process: str) -> Launch:
        """The settings that every component has. Raises ConfigError as `config` does."""
        return self._convert(process, self._table(process), Launch)

    def config(self, process: str, kind: type[C]) -> C:
        """The settings of a component, of the class `kind`. If its table has no `objects` or `needed`, these are
        filled in: the profile's objects, and the services that the component needs. Raises ConfigError that names
        profile, table and field, or the setting of `kind` that has the name of one in `Launch`."""
        table = {k: v for k, v in self._table(process).items() if k not in Launch.__struct_fields__}
        fields = getattr(kind, "__struct_fields__", ())
        if taken := sorted({*fields} & {*Launch.__struct_fields__}):
            raise ConfigError(f"component {process}: every component has a setting {taken[0]}: rename this one's")
        if self.objects is not None and "objects" in fields:
            table = {"objects": self.objects} | table
        if "needed" in fields:
            table = {"needed": needs(process, self.rows())} | table
        return self._convert(process, table, kind)

    def _table(self, process: str) -> dict[str, Any]:
        return self.service.get(named(process).settings or process, {})

    def _convert(self, process: str, table: dict[str, Any], kind: type[C]) -> C:
        try:
            return msgspec.convert(table, kind)
        except msgspec.ValidationError as error:
            raise ConfigError(f"profile {self.name}, [service.{process}]: {field_text(error, kind)}") from error


def names() -> list[str]:
    """The names of the project's profiles."""
    folder = resources.files(PACKAGE).joinpath("profiles")
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def read(
    which: str, overrides: Iterable[str] = (), robot: RobotFiles | None = None, measured: Path | None = None
) -> Profile:
    """Read the profile with the name or path `which` and apply overrides such as `service.sim.seed=3`. `robot` and
    `measured` take the place of the robot and of the measured file that it names.

    Raises ConfigError that names file, table and field.
    """
    source = _find(which)
    try:
        data = tomllib.loads(source.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"profile {which} cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"profile {source}: {error}") from error
    for override in overrides:
        _override(data, override)
    profile = from_data(data, which)
    home = source.parent if isinstance(source, Path) else None
    profile = msgspec.structs.replace(
        profile,
        description=_absolute(profile.description, home),
        measured=_absolute(profile.measured, home),
        objects=_absolute(profile.objects, home),
    )
    if robot is not None:
        profile = profile.of_robot(robot)
    if measured is not None:
        profile = msgspec.structs.replace(profile, measured=str(measured.resolve()))
    return profile.with_own_files()


def from_data(data: dict[str, Any], name: str) -> Profile:
    """The profile of a parsed file; `name` is for error messages. Raises ConfigError as `read` does."""
    try:
        profile = msgspec.structs.replace(msgspec.convert(data, Profile), name=name)
    except msgspec.ValidationError as error:
        text = re.sub(r"Expected `str` matching regex '.*?'(?=$| - at|:)", A_NAME, field_text(error, Profile))
        text = re.sub(r"(.*) - at `key` in `\$\.(\w+)`", r"\2: \1", text)
        raise ConfigError(f"profile {name}: {text}") from error
    if len(set(profile.processes)) < len(profile.processes):
        raise ConfigError(f"profile {name}: processes names a process twice")
    try:
        rows = profile.rows()
    except ConfigError as error:
        raise ConfigError(f"profile {name}, processes: {error}") from error
    owner: dict[str, str] = {}
    for row in rows:
        for service in row.services:
            if service in owner:
                raise ConfigError(f"profile {name}, processes: {owner[service]} and {row.name} both provide {service}")
            owner[service] = row.name
    for table in profile.service:
        named(table)
        profile.launch(table)
    return profile


def _find(which: str) -> Path | Traversable:
    if "/" in which or which.endswith(".toml"):
        path = Path(which).resolve()
        if not path.is_file():
            raise ConfigError(f"there is no profile file {which}")
        return path
    known = names()
    if which not in known:
        raise ConfigError(
            f"there is no profile {which!r}, and it is not the path of a .toml file; {choice_of(which, known)}"
        )
    return resources.files(PACKAGE).joinpath("profiles", f"{which}.toml")


def _override(data: dict[str, Any], override: str) -> None:
    """Apply `a.b.c=value` to a parsed file. A value that is not TOML is taken as a string."""
    path, equals, text = override.partition("=")
    keys = path.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError(f"{override!r} is not a setting; write it as service.sim.seed=3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    table = data
    for key in keys[:-1]:
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise ConfigError(f"{override!r}: {key} is a value, not a table")
    table[keys[-1]] = value


def _kept(description: Path) -> str:
    return str(description if is_shipped(description) else description.resolve())


def _absolute(file: str | None, home: Path | None) -> str | None:
    if file is None or home is None or is_shipped(file):
        return file
    return str((home / file).resolve())
