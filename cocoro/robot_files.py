"""The files of a robot: its description, the values measured on it, and what lies beside the description.

ada.toml            the description
ada-objects.toml    its known objects, in place of the project's own: what its hand takes
ada-paper.toml      its scene `paper`, in place of the project's; so with the name of every scene

What a description that is based on a shipped one has not beside it is taken from beside that one.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cocoro.description import base_of, is_shipped

if TYPE_CHECKING:
    from cocoro.robot import Robot


class RobotFiles(NamedTuple):
    """A robot by its files; the Calliope where nothing is said."""

    name: str = "calliope"
    description: Path | None = None
    """A file, or the name of a robot that the project ships; None: the Calliope's."""
    measured: Path | None = None
    """Values that were measured on this robot."""
    objects: Path | None = None
    """Its known objects; None: the project's own."""

    def load(self) -> Robot:
        """Raises ConfigError naming file and field."""
        from cocoro.robot import Robot  # imports numpy, which is slow

        return Robot.load(self.description, self.measured)

    def with_measured(self, file: Path | None) -> RobotFiles:
        """The same robot with another file of measured values; None keeps its own."""
        return self if file is None else self._replace(measured=file)


def objects_beside(description: str | Path | None) -> Path | None:
    """The file of known objects beside a description; None where there is none."""
    return _beside(description, "objects")


def scene_beside(description: str | Path | None, scene: str) -> Path | None:
    """The file beside a description that stands in for the scene of that name; None where there is none."""
    return _beside(description, scene) if scene.replace("-", "").isalnum() else None


def _beside(description: str | Path | None, word: str) -> Path | None:
    with suppress(OSError, ValueError):  # no path that a file can have
        if description is not None:
            home = Path(str(resources.files("cocoro"))) if is_shipped(description) else Path(description).parent
            file = home / f"{Path(description).stem}-{word}.toml"
            return file.resolve() if file.is_file() else _beside(base_of(description), word)
    return None
