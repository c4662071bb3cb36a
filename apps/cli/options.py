"""Options that several commands share: how typer declares them, and how their values are read.

Every command file imports this one, and `cocoro --help` imports every command file, so it imports little.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.cli import completions
from apps.client.choice import RobotChoice as RobotChoice
from cocoro.errors import ConfigError, choice_of


def name_option(*names: str, help: str) -> Any:
    """An option that takes one of these names."""
    return typer.Option(metavar="|".join(names), autocompletion=completions.of(*names), help=help)


NAME_OR_FILE = "NAME|FILE"

# --- which robot, and how to print ----------------------------------------------------------------

RobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar=NAME_OR_FILE,
        autocompletion=completions.robots,
        help="The robot: its name, or the file of its description; needed only when several are up on this machine.",
    ),
]
AnyRobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar=NAME_OR_FILE,
        autocompletion=completions.described,
        help="The robot: calliope, lekiwi, one that is up here, or the file of its description.",
    ),
]
"""Of commands whose robot need not be up."""
ThroughOption = Annotated[
    str | None,
    typer.Option(
        "--site",
        metavar="[NAME@]DIR",
        help="Reach a robot on other machines through the site in this folder, as NAME.",
    ),
]


InsteadOption = Annotated[
    bool, typer.Option("--instead", help="End the running task first; without, a robot that is busy refuses.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]

SiteOption = Annotated[
    Path | None,
    typer.Option(
        "--site",
        metavar="DIR",
        envvar="COCORO_SITE",
        help="The site's folder; by default $COCORO_SITE, or the current folder if it has a site.toml.",
    ),
]

# --- profiles and the simulator -------------------------------------------------------------------

ProfileArgument = Annotated[
    str,
    typer.Argument(
        help="A profile's name (sim, robot, sim-wire, lekiwi-wire, replay) or file.",
        autocompletion=completions.profiles,
    ),
]
ProfileOption = Annotated[
    str,
    typer.Option(
        "--profile",
        metavar="PROFILE",
        help="Take the ports and the robot's measured file from this profile.",
        autocompletion=completions.profiles,
    ),
]
SceneOption = Annotated[
    str | None,
    typer.Option(
        help="Simulator: a scene's name (paper, follow, targets, random; a wrong one lists all) or its file.",
        autocompletion=completions.scenes,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Any setting of the profile: service.sim.seed=3. Repeatable."),
]
FramesOption = Annotated[
    str | None,
    typer.Option(
        "--frames", metavar="WxH@HZ", envvar="COCORO_FRAMES", help="Size and rate of the camera's frames: 320x240@15."
    ),
]
LatencyOption = Annotated[
    list[str] | None,
    typer.Option("--latency", metavar="NAME=SECONDS", help="Slow a service down: perception=0.5. Repeatable."),
]
ObjectsOption = Annotated[
    Path | None,
    typer.Option(
        "--objects", metavar="FILE", help="Known objects instead of the project's own (`cocoro objects learn`)."
    ),
]
BodyOption = Annotated[
    str,
    name_option("nominal", "worn", help="A body like the nominal model, or one that differs."),
]
MeasuredOption = Annotated[
    Path | None,
    typer.Option("--measured", metavar="FILE", help="Values measured on this robot; they replace the description's."),
]

# --- the learned model ----------------------------------------------------------------------------

ModelOption = Annotated[
    Path | None, typer.Option("--model", metavar="FILE", help="Learned model of the body (from `cocoro learn`).")
]
ReachOption = Annotated[
    str | None,
    name_option("learned", "rigid", help="rigid: reach without the learned model of the arm."),
]
AdaptOption = Annotated[
    bool, typer.Option("--adapt", help="Keep training the learned model of the arm with what the camera sees at work.")
]
ModelOutOption = Annotated[
    Path,
    typer.Option("--model", metavar="FILE", help="Where to write the model; other parts in that file are kept."),
]
SamplesOutOption = Annotated[
    Path, typer.Option("--out", metavar="FILE", help="Where to keep the samples; an existing file is continued.")
]
SendOption = Annotated[bool, typer.Option("--send", help="Send the model to the running planner; no restart needed.")]

# --- tasks ----------------------------------------------------------------------------------------

TimeoutOption = Annotated[
    float | None,
    typer.Option("--timeout", min=0.1, max=3600.0, metavar="SECONDS", help="Fail the task after this time."),
]

# --- captures and topics --------------------------------------------------------------------------


def capture_file(text: str) -> Path:
    """Reads a capture's file or name (latest, fetch, 'fetch red_can', a task's id)."""
    from apps.captures.shelf import find  # slow to import

    return find(text)


CaptureArgument = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        parser=capture_file,
        autocompletion=completions.captures,
        help="A capture: an MCAP file, latest, latest-1, or a task: 'fetch red_can'.",
    ),
]
CapturesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...",
        parser=capture_file,
        autocompletion=completions.captures,
        help="Captures: MCAP files, latest, latest-1, or a task: 'fetch red_can'; for --lerobot also folders.",
    ),
]
CameraOption = Annotated[
    str,
    typer.Option(
        "--camera",
        metavar="robot|outside|both",
        help="For the film: the robot's camera, one that films the simulated robot, or both.",
    ),
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="KEYEXPR", help="Only these keys: base/state, */health, frames. Repeatable."),
]
WithoutOption = Annotated[
    list[str] | None, typer.Option("--without", metavar="KEYEXPR", help="All keys except these. Repeatable.")
]
FromOption = Annotated[
    float | None, typer.Option("--from", metavar="S", help="Start here, in seconds from the capture's start.")
]
ToOption = Annotated[
    float | None, typer.Option("--to", metavar="S", help="End before this, in seconds from the capture's start.")
]
KeyArgument = Annotated[
    str,
    typer.Argument(
        metavar="KEY",
        autocompletion=completions.topics,
        help="base/state, */health, ** (all); `cocoro topics` lists the known keys.",
    ),
]

# --- values with a form of their own --------------------------------------------------------------


def frames_of(text: str) -> dict[str, int | float]:
    """Reads '320x240@15' into width, height and frame_rate_hz; '@15' may be absent. Raises ConfigError."""
    match = re.fullmatch(r"(\d+)x(\d+)(?:@(\d+(?:\.\d+)?))?", text)
    if match is None:
        raise ConfigError(f"--frames {text}: write it as WIDTHxHEIGHT@HZ, for example 320x240@15")
    size: dict[str, int | float] = {"width": int(match[1]), "height": int(match[2])}
    return size | ({"frame_rate_hz": float(match[3])} if match[3] else {})


def latencies_of(texts: Iterable[str]) -> dict[str, float]:
    """Reads 'perception=0.5' and the like into seconds by service name. Raises ConfigError."""
    found: dict[str, float] = {}
    for text in texts:
        name, equals, seconds = text.partition("=")
        try:
            if not name or not equals:
                raise ValueError
            found[name] = float(seconds)
        except ValueError:
            raise ConfigError(f"--latency {text}: write it as NAME=SECONDS, for example perception=0.5") from None
    return found


def scene_of(scene: str) -> str:
    """A scene's name unchanged; the path of a scene file made absolute. Raises ConfigError for an unknown name and a
    missing file."""
    if not scene.endswith(".toml") and os.sep not in scene:
        from sim.scene_names import GENERATED, scene_names

        return one_of("--scene", scene, (*scene_names(), *GENERATED))
    if not Path(scene).is_file():
        raise ConfigError(f"--scene {scene}: no such file; give a .toml file, or the name of a scene")
    return str(Path(scene).resolve())


def one_of(option: str, given: str, known: Iterable[str]) -> str:
    """A value that is allowed, unchanged. Raises ConfigError for another."""
    names = [*known]
    if given not in names:
        raise ConfigError(f"{option} {given}: {choice_of(given, names)}")
    return given
