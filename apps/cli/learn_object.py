"""`cocoro objects learn LABEL`: learns a new object from a picture or the camera, and shows it before saving."""

from __future__ import annotations

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
from apps.cli.output import complain, print_json
from apps.cli.toml_files import save, text_of, with_object
from apps.pictures import save_png
from cocoro.errors import ConfigError, naming
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot

LIVE = "live"
FILE = "objects.toml"
"""The user's catalogue when neither an option nor the running robot names one."""


@dataclass(frozen=True)
class SaveOptions:
    """Options on how the learned object is saved."""

    catalogue: Path | None
    picture: Path | None
    yes: bool | None
    """Whether to save it; None: as the person at the terminal answers."""
    replace: bool
    add: bool
    as_json: bool


async def learn_object(
    choice: RobotChoice, source: str, hints: ObjectHints, saving: SaveOptions, robot: Robot | None = None
) -> int:
    """Learns an object from one view, shows it and saves it; returns the exit code, which is `REFUSED` when nobody said
    whether to save it, or the answer was no.

    `robot` is the robot whose camera took a picture file, the Calliope by default. Raises ConfigError for impossible
    options or a view without an object, MeshError when the view is live and no robot is up.
    """
    view = await of_robot(choice) if source == LIVE else of_picture(Path(source), robot or Robot.load())
    path = saving.catalogue or view.catalogue or Path(FILE)
    catalogue = Catalogue.from_text(text_of(path), str(path))
    before = catalogue.get(hints.label)
    if before is not None and not (saving.replace or saving.add):
        raise ConfigError(
            f"{hints.label} is known already in {path}: --replace replaces its colours, --add adds to them"
        )
    learned = learn(view.object_view, hints, catalogue)
    if saving.add and before is not None:
        learned = replace(learned, known=_both(before, learned.known))
    picture = saving.picture or Path(f"{hints.label}.png")
    seen = _preview(view, learned, path, picture)
    if saving.as_json:
        print_json(_report(learned, seen, picture, path, saved=saving.yes is True))
    else:
        print(_text(learned, seen, picture))
    if saving.yes is False:
        return exits.DONE
    if saving.yes is None and not _confirmed(path, saving):
        return exits.REFUSED
    saved = save(path, learned.known)
    if not saving.as_json:
        print(f"saved in {path}, which has {len(saved)} objects now; {_how_to_use(path, view.catalogue)}")
    return exits.DONE


def _confirmed(path: Path, saving: SaveOptions) -> bool:
    why = "--json asks no question" if saving.as_json else "there is no terminal to ask at"
    if not saving.as_json and sys.stdin.isatty():
        if input(f"save it in {path}? [y/N] ").strip().lower() in ("y", "yes"):
            return True
        why = "as you answered"
    complain(
        f"nothing is saved ({why}): look at the picture, then repeat the command with --yes, or with --no to look only"
    )
    return False


def _how_to_use(path: Path, used: Path | None) -> str:
    if used is not None and used.resolve() == path.resolve():
        return "the running robot knows it after `cocoro down` and `cocoro up`"
    return f"start a robot that knows it with `cocoro up sim --objects {path}`"


def _both(before: ObjectSpec, now: ObjectSpec) -> ObjectSpec:
    """The known row with the new colours added."""
    lab = tuple(dict.fromkeys((*before.lab, *now.lab)))
    shared = tuple(dict.fromkeys((*before.lab_by_shape, *now.lab_by_shape)))
    return msgspec.structs.replace(before, lab=lab, lab_by_shape=shared)


# --- preview and report ---------------------------------------------------------------------------


def _preview(view: CameraView, learned: LearnedObject, path: Path, picture: Path) -> list[str]:
    """Writes the picture; returns descriptions of what the robot would detect with the new object in its catalogue."""
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "objects.toml"
        with naming(draft):
            draft.write_text(with_object(text_of(path), learned.known), encoding="utf-8")
        image, seen = preview(view, learned, draft)
    save_png(image, picture)
    return seen


def _text(learned: LearnedObject, seen: list[str], picture: Path) -> str:
    known, region = learned.known, learned.region
    sizes = " x ".join(f"{100 * side:.1f}" for side in known.size_m)
    measured = learned.measured
    how = "as given" if measured is None else f"measured at {measured.distance_m:.2f} m"
    red, green, blue = (round(255 * channel) for channel in known.rgb)
    lines = [
        f"{known.label}: {known.shape}, {sizes} cm ({how}), {1000 * known.mass_kg:.0f} g, "
        f"{'graspable' if known.graspable else 'not graspable'}",
        f"  region      {region.area_px} pixels at {region.box[0]},{region.box[1]} to {region.box[2]},{region.box[3]}",
        f"  colour      rgb {red} {green} {blue}, chromaticity {learned.range.chromaticity:.0f}, "
        f"{len(known.lab)} boxes in CIELAB{_shared(known)}",
        f"  matched     {learned.matched_share:.0%} of the region's pixels, {learned.elsewhere} other places",
        f"  the robot   {', '.join(seen) if seen else 'would detect nothing here'}",
        *(f"  beware      {warning}" for warning in learned.warnings),
        f"  picture     {picture}",
    ]
    return "\n".join(lines)


def _shared(known: ObjectSpec) -> str:
    return f", {len(known.lab_by_shape)} more shared with other objects" if known.lab_by_shape else ""


def _report(learned: LearnedObject, seen: list[str], picture: Path, path: Path, *, saved: bool) -> dict[str, Any]:
    return {
        "object": msgspec.to_builtins(learned.known),
        "region": {"box_px": learned.region.box, "area_px": learned.region.area_px, "cut": learned.region.cut},
        "measured": None if learned.measured is None else learned.measured._asdict(),
        "chromaticity": learned.range.chromaticity,
        "matched_share": learned.matched_share,
        "elsewhere": learned.elsewhere,
        "overlaps": [overlap._asdict() for overlap in learned.overlaps],
        "seen": seen,
        "warnings": learned.warnings,
        "picture": str(picture),
        "catalogue": str(path),
        "saved": saved,
    }


# --- options with a form of their own -------------------------------------------------------------


def pixel_of(text: str | None) -> tuple[int, int] | None:
    """Reads `--at`: '320,240'. Raises ConfigError."""
    if text is None:
        return None
    if not re.fullmatch(r"\d+,\d+", text):
        raise ConfigError(f"--at {text}: write it as U,V, pixels right and down: 320,240")
    u, v = map(int, text.split(","))
    return u, v


def box_of(text: str | None) -> tuple[int, int, int, int] | None:
    """Reads `--box`: '300,200,360,320'. Raises ConfigError."""
    if text is None:
        return None
    if not re.fullmatch(r"\d+,\d+,\d+,\d+", text):
        raise ConfigError(f"--box {text}: write it as LEFT,TOP,RIGHT,BOTTOM in pixels: 300,200,360,320")
    left, top, right, bottom = map(int, text.split(","))
    return left, top, right, bottom


def size_of(text: str | None) -> tuple[float, ...] | None:
    """Reads `--size`, one to three lengths: '0.066x0.12'. Raises ConfigError."""
    if text is None:
        return None
    if not re.fullmatch(r"\d*\.?\d+(x\d*\.?\d+){0,2}", text) or not all(sizes := tuple(map(float, text.split("x")))):
        raise ConfigError(
            f"--size {text}: write it in metres: 0.08 (a ball), 0.066x0.12 (a can: diameter x height) or 0.1x0.06x0.2 "
            "(a box)"
        )
    if max(sizes) > 2.0:
        raise ConfigError(f"--size {text}: it is in metres, and objects are at most 2 m large")
    return sizes


def hints_of(label: str, **options: Any) -> ObjectHints:
    """The hints from the options. Raises ConfigError for an invalid label or shape, or --at together with --box."""
    if not re.fullmatch(r"[a-z][a-z0-9_-]{0,63}", label):
        raise ConfigError(
            f"{label!r} is not a valid label: small letters, digits, '_' and '-', a letter first: orange_box"
        )
    if options["shape"] not in (None, "cylinder", "sphere", "box"):
        raise ConfigError(f"--shape {options['shape']}: known are cylinder, sphere and box")
    if options["at_px"] is not None and options["box_px"] is not None:
        raise ConfigError("--at and --box: give one of them")
    return ObjectHints(label=label, **options)
