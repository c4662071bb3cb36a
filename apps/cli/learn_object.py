"""`cocoro objects learn LABEL`: learn an object from a picture or the robot's camera, and show it before it is saved."""

from __future__ import annotations

import json
import re
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from apps.appearance.learn import LearnedObject, ObjectHints, learn
from apps.cli import exits
from apps.cli.camera_view import CameraView, of_picture, of_robot, preview
from apps.cli.options import RobotChoice
from apps.cli.toml_files import save, text_of, with_object
from apps.pictures import save_png
from cocoro.errors import ConfigError, naming
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot

LIVE = "live"
FILE = "objects.toml"
"""Default file of the user's catalogue, unless the running robot names one."""


@dataclass(frozen=True)
class SaveOptions:
    """Where and how the result is saved."""

    catalogue: Path | None
    picture: Path | None
    yes: bool
    replace: bool
    add: bool
    as_json: bool


async def learn_object(
    where: RobotChoice, source: str, wanted: ObjectHints, keeping: SaveOptions, robot: Robot | None = None
) -> int:
    """Learn an object from one view, show it, and save it. `robot`: the robot whose camera took a picture file.

    Raises ConfigError for what cannot be, MeshError when the view is to be live and there is no robot.
    """
    sight = await of_robot(where) if source == LIVE else of_picture(Path(source), robot or Robot.load())
    path = keeping.catalogue or sight.catalogue or Path(FILE)
    catalogue = Catalogue.from_text(text_of(path), str(path))
    before = catalogue.get(wanted.label)
    if before is not None and not (keeping.replace or keeping.add):
        raise ConfigError(
            f"{wanted.label} is known already in {path}: --replace forgets what it looked like, --add keeps that too"
        )
    learnt = learn(sight.look, wanted, catalogue)
    if keeping.add and before is not None:
        learnt = replace(learnt, known=_both(before, learnt.known))
    picture = keeping.picture or Path(f"{wanted.label}.png")
    seen = _show(sight, learnt, path, picture)
    if keeping.as_json:
        print(json.dumps(_report(learnt, seen, picture, path, saved=keeping.yes)))
    else:
        print(_text(learnt, seen, picture))
    if not keeping.yes and (keeping.as_json or not _confirmed(path)):
        return exits.DONE
    saved = save(path, learnt.known)
    if not keeping.as_json:
        print(f"saved in {path}, which now has {len(saved)} objects; {_how_to_use(path, sight.catalogue)}")
    return exits.DONE


def _confirmed(path: Path) -> bool:
    if not sys.stdin.isatty():
        print("nothing is saved: look at the picture, then repeat the command with --yes")
        return False
    answer = input(f"save it in {path}? [y/N] ").strip().lower()
    return answer in ("y", "yes")


def _how_to_use(path: Path, used: Path | None) -> str:
    if used is not None and used.resolve() == path.resolve():
        return "the running robot uses it after `cocoro down` and `cocoro up`"
    return f"robots use it that are started with `cocoro up sim --objects {path}`"


def _both(before: ObjectSpec, now: ObjectSpec) -> ObjectSpec:
    """The old row with the colours of the new view added."""
    lab = tuple(dict.fromkeys((*before.lab, *now.lab)))
    shared = tuple(dict.fromkeys((*before.lab_by_shape, *now.lab_by_shape)))
    return msgspec.structs.replace(before, lab=lab, lab_by_shape=shared)


# --- report ---------------------------------------------------------------------------------------


def _show(sight: CameraView, learnt: LearnedObject, path: Path, picture: Path) -> list[str]:
    """Write the picture. Returns the detections in words of a perception that knows the new object."""
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "objects.toml"
        with naming(draft):
            draft.write_text(with_object(text_of(path), learnt.known), encoding="utf-8")
        image, seen = preview(sight, learnt, draft)
    save_png(image, picture)
    return seen


def _text(learnt: LearnedObject, seen: list[str], picture: Path) -> str:
    known, region = learnt.known, learnt.region
    sizes = " x ".join(f"{100 * side:.1f}" for side in known.size_m)
    measured = learnt.measured
    how = "as given" if measured is None else f"measured at {measured.distance_m:.2f} m"
    red, green, blue = (round(255 * channel) for channel in known.rgb)
    lines = [
        f"{known.label}: {known.shape}, {sizes} cm ({how}), {1000 * known.mass_kg:.0f} g, "
        f"{'graspable' if known.graspable else 'not graspable'}",
        f"  region      {region.area_px} pixels at {region.box[0]},{region.box[1]} to {region.box[2]},{region.box[3]}",
        f"  colour      rgb {red} {green} {blue}, chromaticity {learnt.range.chromaticity:.0f}, "
        f"{len(known.lab)} boxes in CIELAB{_shared(known)}",
        f"  matched     {learnt.matched_share:.0%} of the region's pixels, {learnt.elsewhere} other places",
        f"  the robot   {', '.join(seen) if seen else 'detects no known object'}",
        *(f"  beware      {warning}" for warning in learnt.warnings),
        f"  picture     {picture}",
    ]
    return "\n".join(lines)


def _shared(known: ObjectSpec) -> str:
    return f", {len(known.lab_by_shape)} more that other objects share" if known.lab_by_shape else ""


def _report(learnt: LearnedObject, seen: list[str], picture: Path, path: Path, *, saved: bool) -> dict[str, Any]:
    return {
        "object": msgspec.to_builtins(learnt.known),
        "region": {"box_px": learnt.region.box, "area_px": learnt.region.area_px, "cut": learnt.region.cut},
        "measured": None if learnt.measured is None else learnt.measured._asdict(),
        "chromaticity": learnt.range.chromaticity,
        "matched_share": learnt.matched_share,
        "elsewhere": learnt.elsewhere,
        "overlaps": [overlap._asdict() for overlap in learnt.overlaps],
        "seen": seen,
        "warnings": learnt.warnings,
        "picture": str(picture),
        "catalogue": str(path),
        "saved": saved,
    }


# --- values of options ---------------------------------------------------------------------------


def pixel_of(text: str | None) -> tuple[int, int] | None:
    """Reads '320,240': (u, v), pixels. Raises ConfigError."""
    if text is None:
        return None
    if not re.fullmatch(r"\d+,\d+", text):
        raise ConfigError(f"--at {text}: write it as U,V, pixels right and down: 320,240")
    u, v = map(int, text.split(","))
    return u, v


def box_of(text: str | None) -> tuple[int, int, int, int] | None:
    """Reads '300,200,360,320': (left, top, right, bottom), pixels. Raises ConfigError."""
    if text is None:
        return None
    if not re.fullmatch(r"\d+,\d+,\d+,\d+", text):
        raise ConfigError(f"--box {text}: write it as LEFT,TOP,RIGHT,BOTTOM in pixels: 300,200,360,320")
    left, top, right, bottom = map(int, text.split(","))
    return left, top, right, bottom


def size_of(text: str | None) -> tuple[float, ...] | None:
    """Reads '0.066x0.12', one to three lengths in metres. Raises ConfigError."""
    if text is None:
        return None
    if not re.fullmatch(r"\d*\.?\d+(x\d*\.?\d+){0,2}", text) or not all(sizes := tuple(map(float, text.split("x")))):
        raise ConfigError(
            f"--size {text}: write it in metres: 0.08 (a ball), 0.066x0.12 (a can: diameter x height) or 0.1x0.06x0.2 "
            "(a box)"
        )
    if max(sizes) > 2.0:
        raise ConfigError(f"--size {text}: it is in metres; objects are at most 2 m large")
    return sizes


def hints_of(label: str, **options: Any) -> ObjectHints:
    """Raises ConfigError for an impossible label or shape."""
    if not re.fullmatch(r"[a-z][a-z0-9_-]{0,63}", label):
        raise ConfigError(
            f"{label!r} is not a label: use small letters, digits, '_' and '-', a letter first: orange_box"
        )
    if options["shape"] not in (None, "cylinder", "sphere", "box"):
        raise ConfigError(f"--shape {options['shape']}: known are cylinder, sphere and box")
    if options["at_px"] is not None and options["box_px"] is not None:
        raise ConfigError("give --at or --box, not both")
    return ObjectHints(label=label, **options)
