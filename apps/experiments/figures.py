"""Plots of the experiments. Only this module imports matplotlib, an extra, and only when it draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.learning import dataset, study
from apps.learning.dataset import HandRow
from apps.learning.lesson import sightings
from cocoro.errors import ConfigError
from cocoro.learning import model
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OURS, OTHER, TRUE, FAINT = "#1b6ca8", "#c8553d", "#2f2f2f", "#b9b9b9"
COLOURS = (OURS, OTHER, "#6a994e", "#8a5a9e")
SMOOTHED = 15
"""Number of sightings over which the bent arm's errors are averaged."""


def available() -> None:
    """Raises ConfigError where matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            "the experiments' plots need matplotlib: pip install 'cocoro-mesh[experiments]'; or give --no-plots"
        ) from error


def sheet(columns: int = 1, rows: int = 1, *, width: float = 5.0, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """A figure and its axes, row by row, without matplotlib's global state. Sizes in inches."""
    from matplotlib.figure import Figure as Sheet

    figure = Sheet(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    found: list[Axes] = list(axes.flat)
    for axis in found:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color="#e6e6e6", linewidth=0.6)
    return figure, found


def hand_places(samples: Path, learned: Path, robot: Robot) -> Figure:
    """Held-out places of the hand, from above and from the side: seen, by the nominal model, by the learned map."""
    nominal = NominalModel(robot)
    _, held = study.split(study.clean(sightings(dataset.read(samples, HandRow, robot).rows), nominal))
    arm = model.load(learned, robot).arm
    assert arm is not None
    held = held.pick(slice(None, None, max(len(held) // 150, 1)))
    modelled, mapped = nominal.predict(held.angles_rad), model.hand_map(arm, robot).predict(held.angles_rad)
    figure, axes = sheet(2, width=4.6, height=4.6)
    for axis, (one, other, label) in zip(axes, ((0, 1, "left, m"), (0, 2, "up, m")), strict=True):
        for start, end in zip(held.places_m, modelled, strict=True):
            axis.plot([start[one], end[one]], [start[other], end[other]], color=FAINT, linewidth=0.7, zorder=1)
        axis.scatter(modelled[:, one], modelled[:, other], s=9, color=OTHER, label="the nominal model", zorder=2)
        axis.scatter(mapped[:, one], mapped[:, other], s=9, color=OURS, label="the learned map", zorder=3)
        axis.scatter(held.places_m[:, one], held.places_m[:, other], s=26, facecolors="none", edgecolors=TRUE,
                     linewidths=0.7, label="seen", zorder=4)  # fmt: skip
        axis.set(xlabel="ahead, m", ylabel=label, aspect="equal")
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, fontsize=8, ncols=3, loc="outside lower center")
    return figure


def curves(seeds: Sequence[Mapping[str, Mapping[str, float]]]) -> Figure:
    """Held-out error against the number of samples, for each method of `lessons.learn`; a line for each seed."""
    from matplotlib.ticker import LogLocator

    figure, (axis,) = sheet(width=6.0)
    names = {
        "default": "ours: 81 bases over the nominal model",
        "rigid": "the rigid body, calibrated",
        "paper searched": "the paper's rule, its grid search made again",
        "paper": "the paper's rule, best reading of the text",
    }
    for (key, label), colour in zip(names.items(), COLOURS, strict=True):
        sizes = sorted({int(size) for seed in seeds for size in seed[key]})
        lines = np.array([[100 * seed[key].get(str(size), np.nan) for size in sizes] for seed in seeds])
        axis.plot(sizes, lines.T, color=colour, linewidth=0.5, alpha=0.4)
        axis.plot(sizes, np.nanmean(lines, axis=0), color=colour, marker="o", markersize=4, label=label)
    axis.set(xscale="log", yscale="log", xlabel="samples", ylabel="held-out error, RMS, cm")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_locator(LogLocator(subs=(2, 3, 5)))
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.legend(frameon=False, fontsize=8)
    return figure


def bend(seeds: Sequence[Mapping[str, Any]]) -> Figure:
    """Error of each sighting before and after the arm is bent (`lessons.bend`): median over the seeds, smoothed."""
    figure, (axis,) = sheet(width=6.0)
    before = min(seed["bent_at"] for seed in seeds)
    after = min(len(seed["fixed_m"]) - seed["bent_at"] for seed in seeds)
    for key, label, colour in (("fixed_m", "the map, fixed", OTHER), ("adapted_m", "the map, trained further", OURS)):
        lines = np.array([seed[key][seed["bent_at"] - before : seed["bent_at"] + after] for seed in seeds])
        middle = np.median(100 * lines, axis=0)
        smooth = np.convolve(middle, np.ones(SMOOTHED) / SMOOTHED, mode="valid")
        axis.plot(np.arange(len(smooth)) - before + SMOOTHED // 2, smooth, color=colour, label=label)
    axis.axvline(0, color=TRUE, linewidth=0.8, linestyle=":")
    axis.set(xlabel="sightings since the bend", ylabel="error, cm", ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)
    return figure


def reaches(traces: Mapping[tuple[str, str], Mapping[str, list[Any]]], titles: Sequence[str]) -> Figure:
    """The hand's path: a column for each method, rows from above and from the side."""
    figure, axes = sheet(2, 2, width=4.2, height=3.6)
    ways = list(dict.fromkeys(way for way, _ in traces))
    for column, way in enumerate(ways):
        for (method, scene), trace in traces.items():
            if method != way:
                continue
            hidden = scene.endswith("hidden")
            # Leave out the arm's unfolding before the first target.
            first = trace["target"][0]
            later = next(number for number, target in enumerate(trace["target"]) if target != first)
            hand = np.array(trace["hand_m"][later:])
            targets = np.array([t for t in trace["target_m"] if t is not None])
            label, colour, line = ("marker hidden", OTHER, "--") if hidden else ("marker in view", OURS, "-")
            for axis, other in ((axes[column], 1), (axes[2 + column], 2)):
                axis.plot(hand[:, 0], hand[:, other], color=colour, linestyle=line, linewidth=0.8, label=label)
                axis.scatter(targets[:, 0], targets[:, other], s=60, facecolors="none", edgecolors=TRUE, zorder=3)
                axis.set(xlabel="ahead, m", ylabel="left, m" if other == 1 else "up, m", aspect="equal")
        axes[column].set_title(titles[column], fontsize=9)
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, fontsize=8, ncols=2, loc="outside lower center")
    return figure


def wheel_trials(seeds: Sequence[tuple[Mapping[str, Any], float]]) -> Figure:
    """Error of the wheel distance over the trials; each seed is a fit and the true distance in m."""
    figure, (left, right) = sheet(2, width=5.2)
    for fit, true_m in seeds:
        after = [np.nan if value is None else 1000 * (value - true_m) for value in fit["after_m"]]
        left.plot(2 * np.arange(1, len(after) + 1), after, color=OURS, linewidth=0.8, alpha=0.7)
        errors = 1000 * (np.array(fit["estimates_m"]) - true_m)
        right.scatter(np.arange(1, len(errors) + 1), errors, s=5, color=OURS, alpha=0.5)
    for axis in (left, right):
        axis.axhline(0, color=TRUE, linewidth=0.8)
    left.axhspan(-8, 8, color=FAINT, alpha=0.25, linewidth=0)
    left.set(xlabel="trials", ylabel="fit to all so far, less the truth, mm", ylim=(-10, 10))
    right.set(xlabel="trial", ylabel="its own estimate, less the truth, mm", ylim=(-25, 25))
    return figure


def paths(traces: Sequence[Mapping[str, list[Any]]], asked_m: float) -> Figure:
    """The robot's true paths to the balls, from above, with circles at the requested distance."""
    from matplotlib.patches import Circle

    figure, (axis,) = sheet(width=5.6, height=5.0)
    for trace in traces:
        way = np.array(trace["body"])
        ball = next(place for place in trace["target_m"] if place is not None)
        axis.plot(way[:, 0], way[:, 1], color=OURS, linewidth=0.7, alpha=0.6)
        axis.plot(*way[-1, :2], marker="o", markersize=3, color=OTHER)
        axis.add_patch(Circle((ball[0], ball[1]), asked_m + 0.03, fill=False, color=FAINT, linewidth=0.5))
        axis.plot(ball[0], ball[1], marker="o", color="#e0b400", markersize=7)
    axis.set(xlabel="ahead, m", ylabel="left, m", aspect="equal")
    return figure


def square(traces: Mapping[str, Mapping[str, list[Any]]]) -> Figure:
    """The robot's true path behind the ball for each method, and the ball's, from above."""
    figure, (axis,) = sheet(width=5.6, height=5.0)
    for (label, trace), colour in zip(traces.items(), COLOURS, strict=False):
        following = np.array([phase == "follow" for phase in trace["phase"]])
        way = np.array(trace["body"])[following]
        axis.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.0, label=label)
    ball = np.array([place for place in next(iter(traces.values()))["target_m"] if place is not None])
    axis.plot(ball[:, 0], ball[:, 1], color=TRUE, linewidth=0.8, linestyle=":", label="the ball")
    axis.set(xlabel="ahead, m", ylabel="left, m", aspect="equal")
    axis.legend(frameon=False, fontsize=8)
    return figure


def phases(ways: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Mean duration of each phase over the runs of each method."""
    figure, (axis,) = sheet(width=7.0, height=2.6)
    names = list(dict.fromkeys(p["name"] for runs in ways.values() for run in runs for p in run["phases"]))
    palette = ("#8ecae6", "#219ebc", "#126782", "#ffb703", "#fb8500", "#6a994e", "#bc4749", "#a7a7a7")
    begun = np.zeros(len(ways))
    for number, name in enumerate(names):
        spent = [
            sum(p["sim_s"] for run in runs for p in run["phases"] if p["name"] == name) / max(len(runs), 1)
            for runs in ways.values()
        ]
        axis.barh(list(ways), spent, left=begun, color=palette[number % len(palette)], label=name, height=0.6)
        begun += spent
    axis.invert_yaxis()
    axis.set(xlabel="simulated seconds")
    axis.legend(frameon=False, fontsize=8, ncols=min(len(names), 4), loc="upper center", bbox_to_anchor=(0.5, -0.25))
    return figure
