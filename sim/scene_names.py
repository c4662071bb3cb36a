"""The names of the scenes, apart from what reads them: a shell that completes one must not wait for numpy."""

from __future__ import annotations

from importlib import resources

DEFAULT = "paper"
"""The scene where none is named."""
GENERATED = ("random", "rooms", "rooms-empty", "paper-scaled", "random-scaled")
"""Names of the scenes that `sim.random_scene` makes."""


def scene_names() -> list[str]:
    """Names of the scenes that come with the project as files."""
    folder = resources.files("sim").joinpath("scenes")
    return sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))
