"""The catalogue of known objects: shape, size and colour, from one TOML file (`objects.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from functools import lru_cache
from importlib import resources
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from cocoro.errors import ConfigError, field_text
from cocoro.units import Positive, Share, Vec3

Label = Annotated[str, Meta(pattern=r"\A[a-z][a-z0-9_-]{0,63}\Z")]

DEFAULT_FILE = "objects.toml"


class LabBox(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A box in CIELAB (D65): L 0 to 100, a and b -128 to 127; both ends are inside."""

    low: Vec3
    high: Vec3

    def __post_init__(self) -> None:
        for axis, low, high in zip("Lab", self.low, self.high, strict=True):
            bounds = (0.0, 100.0) if axis == "L" else (-128.0, 127.0)
            if not bounds[0] <= low < high <= bounds[1]:
                raise ValueError(f"{axis} must rise within {bounds[0]:g} to {bounds[1]:g}, not {low:g} to {high:g}")


class ObjectSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One row of the catalogue. A cylinder stands upright; a box stands on its x-y face, at any yaw."""

    label: Label
    shape: Literal["cylinder", "sphere", "box"]
    radius_m: Positive | None = None
    """For a cylinder and a sphere."""
    height_m: Positive | None = None
    """For a cylinder."""
    box_m: tuple[Positive, Positive, Positive] | None = msgspec.field(default=None, name="size_m")
    """For a box: full x, y, z; `size_m` in the file."""
    mass_kg: Positive = 0.2
    graspable: bool = False
    marker: bool = False
    """It is the ball on the robot's own hand."""
    rgb: tuple[Share, Share, Share]
    """Surface colour under full white light, sRGB, each 0 to 1."""
    lab: Annotated[tuple[LabBox, ...], Meta(min_length=1)]
    """A pixel belongs to the object if any of these boxes contains its colour."""
    lab_by_shape: tuple[LabBox, ...] = ()
    """Colours that it shares with another object; only a detector that distinguishes the two by shape uses them."""

    def __post_init__(self) -> None:
        wanted = {"cylinder": {"radius_m", "height_m"}, "sphere": {"radius_m"}, "box": {"size_m"}}[self.shape]
        sizes = {"radius_m": self.radius_m, "height_m": self.height_m, "size_m": self.box_m}
        given = {name for name, value in sizes.items() if value is not None}
        if missing := sorted(wanted - given):
            raise ValueError(f"a {self.shape} needs {' and '.join(missing)}")
        if surplus := sorted(given - wanted):
            raise ValueError(f"a {self.shape} has no {' or '.join(surplus)}")

    @property
    def size_m(self) -> Vec3:
        """Full x, y, z of the upright object's bounding box."""
        if self.box_m is not None:
            return self.box_m
        assert self.radius_m is not None
        diameter = 2 * self.radius_m
        return diameter, diameter, diameter if self.height_m is None else self.height_m

    @property
    def planar_radius_m(self) -> float:
        """Radius of the upright object seen from above; for a box that of the circle of equal area."""
        if self.box_m is not None:
            return float((self.box_m[0] * self.box_m[1] / pi) ** 0.5)
        assert self.radius_m is not None
        return self.radius_m


class _CatalogueFile(msgspec.Struct, forbid_unknown_fields=True):
    object: list[dict[str, Any]]


class Catalogue:
    """The known objects, in the file's order; `catalogue[label]`, `label in catalogue`, iteration, `len`."""

    def __init__(self, objects: tuple[ObjectSpec, ...]) -> None:
        self.objects = objects
        self._by_label = {known.label: known for known in objects}

    @classmethod
    def load(cls, path: Path | None = None) -> Catalogue:
        """Read the project's own catalogue, or another file. Raises ConfigError naming file, table and field."""
        where = str(path) if path else DEFAULT_FILE
        try:
            text = path.read_text() if path else own_text()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"known objects {where}: {error}") from error
        return cls.from_text(text, where)

    @classmethod
    def from_text(cls, text: str, where: str) -> Catalogue:
        """Read a catalogue's text; `where` it is from, for messages. Raises ConfigError like `load`."""
        return cls(_objects_of(text, where))

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(self._by_label)

    @property
    def targets(self) -> tuple[ObjectSpec, ...]:
        """All objects except the hand's marker."""
        return tuple(known for known in self.objects if not known.marker)

    @property
    def marker(self) -> ObjectSpec | None:
        return next((known for known in self.objects if known.marker), None)

    def get(self, label: str) -> ObjectSpec | None:
        return self._by_label.get(label)

    def __getitem__(self, label: str) -> ObjectSpec:
        return self._by_label[label]

    def __contains__(self, label: object) -> bool:
        return label in self._by_label

    def __iter__(self) -> Iterator[ObjectSpec]:
        return iter(self.objects)

    def __len__(self) -> int:
        return len(self.objects)


def own_text() -> str:
    """The text of the project's own catalogue."""
    return resources.files("cocoro").joinpath(DEFAULT_FILE).read_text()


@lru_cache(maxsize=8)
def _objects_of(text: str, where: str) -> tuple[ObjectSpec, ...]:
    """The objects of a catalogue's text, as `Catalogue.from_text`. A text that was read before is not read again: the
    services and the scene of a rehearsal read the same one."""
    try:
        rows = msgspec.convert(tomllib.loads(text), _CatalogueFile).object
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"known objects {where}: {error}") from error
    except msgspec.ValidationError as error:
        raise ConfigError(f"known objects {where}: {error}; it must be a list of [[object]] tables") from error
    objects: list[ObjectSpec] = []
    for number, row in enumerate(rows, start=1):
        table = f"[[object]] {number} ({row.get('label', 'no label')})"
        try:
            known = msgspec.convert(row, ObjectSpec)
        except msgspec.ValidationError as error:
            raise ConfigError(f"known objects {where}: {table}: {field_text(error, ObjectSpec)}") from error
        for earlier in objects:
            if known.label == earlier.label:
                raise ConfigError(f"known objects {where}: {table}: label: an earlier object has it already")
            if known.marker and earlier.marker:
                raise ConfigError(f"known objects {where}: {table}: marker: {earlier.label} is the marker already")
        objects.append(known)
    if not objects:
        raise ConfigError(f"known objects {where}: it has no [[object]]")
    return tuple(objects)
