"""Scene files: the objects and obstacles around the robot, the light, and where the robot starts."""

from __future__ import annotations

import tomllib
from importlib import resources
from math import cos, hypot, isfinite, pi, sin
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from cocoro.errors import ConfigError, choice_of, field_text
from cocoro.objects import Catalogue
from cocoro.units import Vec3
from sim.render.interface import Shape
from sim.scene_names import GENERATED, scene_names
from sim.seeds import stream

ScenePoint = Annotated[tuple[float, ...], Meta(min_length=2, max_length=3)]

_COLOURS: dict[str, Vec3] = {
    "red": (0.80, 0.04, 0.05),
    "green": (0.03, 0.55, 0.10),
    "blue": (0.04, 0.14, 0.75),
    "yellow": (0.90, 0.78, 0.03),
}
_GREY: Vec3 = (0.6, 0.6, 0.6)
_SIZES: dict[Shape, tuple[str, ...]] = {
    "box": ("size_m",),
    "cylinder": ("radius_m", "height_m"),
    "sphere": ("radius_m",),
}


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of a scene file."""

    def problem(self) -> str | None:
        """The first invalid value, in a sentence that begins with the field's name; None when all are valid."""
        return None


class _Solid(_Table, frozen=True, kw_only=True):
    """A thing with a primitive shape."""

    shape: Shape
    radius_m: float | None = None
    height_m: float | None = None
    size_m: Vec3 | None = None
    rgb: Vec3 | None = None
    """0 to 1 per channel."""

    def problem(self) -> str | None:
        wanted = _SIZES[self.shape]
        for field in ("radius_m", "height_m", "size_m"):
            value = getattr(self, field)
            if field in wanted and value is None:
                return f"{field} is missing: a {self.shape} needs {' and '.join(wanted)}"
            if field not in wanted and value is not None:
                return f"{field} does not belong to a {self.shape}, which has {' and '.join(wanted)}"
            if value is not None and any(number <= 0 for number in _numbers(value)):
                return f"{field} must be > 0"
        if self.rgb is not None and not all(0.0 <= channel <= 1.0 for channel in self.rgb):
            return "rgb must be 0 to 1 a channel"
        return None

    @property
    def colour(self) -> Vec3:
        return self.rgb if self.rgb is not None else _GREY

    @property
    def dimensions_m(self) -> tuple[float, ...]:
        """box: full x, y, z; cylinder: radius, height; sphere: radius."""
        return tuple(number for field in _SIZES[self.shape] for number in _numbers(getattr(self, field)))

    @property
    def half_width_m(self) -> float:
        """Horizontal distance from the centre to the edge."""
        return max(self.dimensions_m[:2]) / 2 if self.shape == "box" else self.dimensions_m[0]

    @property
    def standing_height_m(self) -> float:
        """Height of the centre above the floor when it stands."""
        if self.shape == "sphere":
            return self.dimensions_m[0]
        return self.dimensions_m[-1] / 2


class SceneObject(_Solid, frozen=True, kw_only=True):
    """An object that the robot can fetch, follow or knock over."""

    label: str
    position_m: ScenePoint
    """In the robot's frame at the start: [x, y] for an object on the floor, [x, y, z] with the height of its centre."""
    mass_kg: float = 0.2
    path_m: tuple[ScenePoint, ...] = ()
    """Waypoints after `position_m`, in the same frame; with two numbers the height does not change."""
    speed_mps: float = 0.0
    path_loop: bool = False
    """Whether it returns from the last waypoint to the start and repeats; otherwise it stops there."""
    floating: bool = False
    """Whether it stays in the air at its position."""

    def problem(self) -> str | None:
        if not self.label or any(char in self.label for char in " ~,/"):
            return "label must be one word, without '~', ',' or '/'"
        if self.mass_kg <= 0:
            return "mass_kg must be > 0"
        if self.speed_mps < 0:
            return "speed_mps must be >= 0"
        if self.path_m and self.speed_mps == 0:
            return "speed_mps must be > 0 for an object with a path_m"
        if self.speed_mps and not self.path_m:
            return "path_m is missing: an object with a speed_mps needs its waypoints"
        return _Solid.problem(self)

    @property
    def colour(self) -> Vec3:
        """`rgb`, which `load_scene` takes from the known object with this label when the file has none; else the colour
        in the label ('red_box'), else grey."""
        return self.rgb if self.rgb is not None else _COLOURS.get(self.label.split("_")[0], _GREY)

    @property
    def kinematic(self) -> bool:
        """Whether it moves or floats by itself, so that no contact moves it."""
        return self.floating or bool(self.path_m)

    @property
    def centre_m(self) -> Vec3:
        """Centre at the start, in the robot's frame at the start."""
        return _at(self.position_m, self.standing_height_m)


class Obstacle(_Solid, frozen=True, kw_only=True):
    """A fixed obstacle."""

    position_m: tuple[float, float]
    """In the robot's frame at the start."""
    yaw_rad: float = 0.0

    @property
    def centre_m(self) -> Vec3:
        return _at(self.position_m, self.standing_height_m)


class Light(_Table, frozen=True, kw_only=True):
    """A distant lamp and ambient light; see `sim.render.interface.Lighting`."""

    ambient: float = 0.55
    diffuse: float = 0.45
    direction: Vec3 = (-0.4, 0.3, -1.0)
    """Direction in which the lamp's light travels, world frame; any length except zero."""
    temperature_k: float = 5500.0

    def problem(self) -> str | None:
        for field in ("ambient", "diffuse"):
            if not 0.0 <= getattr(self, field) <= 1.0:
                return f"{field} must be 0 to 1"
        if hypot(*self.direction) == 0.0:
            return "direction must not be zero"
        if not 1000.0 <= self.temperature_k <= 40000.0:
            return "temperature_k must be 1000 to 40000"
        return None


class Start(_Table, frozen=True, kw_only=True):
    """The robot's pose at the start, in the world."""

    position_m: tuple[float, float] = (0.0, 0.0)
    yaw_rad: float = 0.0


class Scatter(_Table, frozen=True, kw_only=True):
    """Random differences between two runs of one scene, drawn from the run's seed."""

    position_m: float = 0.0
    """Largest distance of each standing object from its place in the file, uniform over the disc."""

    def problem(self) -> str | None:
        return "position_m must be >= 0" if self.position_m < 0 else None


class Scene(msgspec.Struct, frozen=True, kw_only=True):
    """A valid scene, with the seed's scatter applied."""

    name: str
    objects: tuple[SceneObject, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    light: Light = Light()
    robot: Start = Start()

    def object(self, label: str) -> SceneObject:
        """The object with this label. Raises KeyError that names the existing labels."""
        for item in self.objects:
            if item.label == label:
                return item
        raise KeyError(f"{label!r}; the scene has {', '.join(o.label for o in self.objects) or 'no objects'}")

    def to_world(self, point_m: Vec3) -> Vec3:
        """Transform a point from the robot's frame at the start to the world frame, m."""
        x, y, z = point_m
        c, s = cos(self.robot.yaw_rad), sin(self.robot.yaw_rad)
        return self.robot.position_m[0] + c * x - s * y, self.robot.position_m[1] + s * x + c * y, z


def load_scene(name_or_path: str | Path, seed: int = 0, catalogue: Catalogue | None = None) -> Scene:
    """Read a scene: one that comes with the project by its name (`paper`), or a TOML file by its path.

    `catalogue` holds the known objects that give their colours; None is the project's own. Raises ConfigError that
    names the file, the table and the field.
    """
    known_objects = Catalogue.load() if catalogue is None else catalogue
    text, where = _read(name_or_path)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not TOML: {error}") from error
    known = {"name", "object", "obstacle", "light", "robot", "scatter"}
    if extra := sorted(set(data) - known):
        raise ConfigError(f"{where}: unknown table or field {extra[0]!r}; {choice_of(extra[0], sorted(known))}")
    name = data.get("name", Path(name_or_path).stem)
    if not isinstance(name, str):
        raise ConfigError(f"{where}: name must be text")
    objects = _rows(data, "object", SceneObject, where)
    _check_labels(objects, where)
    scene = Scene(
        name=name,
        objects=tuple(_coloured(item, known_objects) for item in objects),
        obstacles=tuple(_rows(data, "obstacle", Obstacle, where)),
        light=_table(data.get("light", {}), Light, f"{where}, [light]"),
        robot=_table(data.get("robot", {}), Start, f"{where}, [robot]"),
    )
    scatter = _table(data.get("scatter", {}), Scatter, f"{where}, [scatter]")
    return _scattered(scene, scatter, seed)


_T = TypeVar("_T", bound=_Table)


def _read(name_or_path: str | Path) -> tuple[str, str]:
    name = str(name_or_path)
    if name in scene_names():
        return resources.files("sim").joinpath("scenes", f"{name}.toml").read_text(), f"scene {name}"
    path = Path(name_or_path)
    if path.suffix != ".toml" and not path.exists():
        raise ConfigError(f"no scene {name!r}, and no such .toml file; {choice_of(name, [*scene_names(), *GENERATED])}")
    try:
        return path.read_text(), f"scene {path.name}"
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"scene {path}: {getattr(error, 'strerror', None) or error}") from error


def _rows(data: dict[str, Any], key: str, kind: type[_T], where: str) -> list[_T]:
    rows = data.get(key, [])
    if not isinstance(rows, list):
        raise ConfigError(f"{where}: [{key}] must be written [[{key}]], once for each")
    found = []
    for number, row in enumerate(rows, 1):
        label = f" {row['label']!r}" if isinstance(row, dict) and isinstance(row.get("label"), str) else ""
        found.append(_table(row, kind, f"{where}, [[{key}]] {number}{label}"))
    return found


def _table(data: Any, kind: type[_T], where: str) -> _T:
    try:
        table = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {field_text(error, kind)}") from error
    for name in table.__struct_fields__:
        if not all(isfinite(number) for number in _numbers(getattr(table, name))):
            raise ConfigError(f"{where}: {name} must be finite")
    if problem := table.problem():
        raise ConfigError(f"{where}: {problem}")
    return table


def _coloured(item: SceneObject, catalogue: Catalogue) -> SceneObject:
    known = catalogue.get(item.label)
    return msgspec.structs.replace(item, rgb=known.rgb) if item.rgb is None and known is not None else item


def _check_labels(objects: list[SceneObject], where: str) -> None:
    seen: set[str] = set()
    for number, item in enumerate(objects, 1):
        if item.label in seen:
            raise ConfigError(f"{where}, [[object]] {number} {item.label!r}: label is taken by another object")
        seen.add(item.label)


def _numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return [float(value)] if isinstance(value, (int, float)) and not isinstance(value, bool) else []


def _at(place: ScenePoint, height_m: float) -> Vec3:
    return place[0], place[1], place[2] if len(place) == 3 else height_m


def _scattered(scene: Scene, scatter: Scatter, seed: int) -> Scene:
    if scatter.position_m == 0.0:
        return scene
    draws = stream(seed, "scene scatter")
    moved = []
    for item in scene.objects:
        turn, reach = draws.uniform(0.0, 2 * pi), scatter.position_m * draws.uniform() ** 0.5
        x, y, *height = item.position_m
        place = item.position_m if item.kinematic else (x + reach * cos(turn), y + reach * sin(turn), *height)
        moved.append(msgspec.structs.replace(item, position_m=place))
    return msgspec.structs.replace(scene, objects=tuple(moved))
