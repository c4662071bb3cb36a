"""`cocoro new robot NAME --urdf FILE`: writes a robot's description, a profile and the page of what is missing."""

from __future__ import annotations

from pathlib import Path

from apps.cli import exits
from apps.cli.new_files import check_name, free_folder, put, tell_of
from apps.urdf.describing import describe
from apps.urdf.things import objects_text, scene_texts
from apps.urdf.writing import PAGE, description_text, page_text, profile_text


def write_robot(name: str, urdf: Path, into: Path, as_json: bool = False) -> int:
    """Writes the robot's files into the folder `into`/`name`. Raises ConfigError for an invalid or taken name, for a
    URDF of which no description can be made, and for a file that cannot be written."""
    check_name(name)
    folder = free_folder(name, into)
    made = describe(urdf, name, postures=True)
    source = "".join(letter if letter.isprintable() else "?" for letter in urdf.name)
    profile = folder / f"{name}-sim.toml"
    files = {
        folder / f"{name}.toml": description_text(made.data, source),
        profile: profile_text(name),
        folder / PAGE: page_text(name, source, made.missing),
    }
    if (objects := objects_text(name, made.robot)) is not None:
        files[folder / f"{name}-objects.toml"] = objects
    files |= {folder / f"{name}-{scene}.toml": text for scene, text in scene_texts(name, made.robot)}
    for path, text in files.items():
        put(path, text)
    hints = (
        (f"cocoro rehearse go-to red_can --robot {folder / name}.toml", "tries a task in simulation"),
        (f"cocoro up {profile}", "runs it in the simulator"),
        (f"cocoro doctor {profile}", "checks the profile and the robot"),
    )
    where = f"{len(made.missing)} things are assumed, guessed or missing: {folder / PAGE}."
    tell_of(list(files), where, hints, as_json)
    return exits.DONE
