"""Learning between the rehearsals of the experiments: a model of each seed's body, and its error on a bent arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from apps.learning import dataset, study
from apps.learning.dataset import HandRow, WheelRow
from apps.learning.lesson import learn_arm, learn_wheels, sightings
from apps.learning.paper_rule import ALLOWED
from apps.learning.wheels import WheelFit, fit_wheels
from cocoro.clock import NS
from cocoro.learning import model
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot
from services.planning.teaching import Adapter

SIZES = (100, 300, 1000, 2000)
"""Numbers of samples of the learning curves."""
CURVES = {
    "default": study.BEST,
    "rigid": study.RIGID[-1],
    "paper": study.PAPER,
    "paper searched": study.PAPER_SEARCHED,
}
"""The learning curves: ours, and the baselines at their best."""


def load_robot(description: str | None = None, measured: str | None = None) -> Robot:
    """The robot of these files; the Calliope where none is given. Raises ConfigError naming file and field."""
    return Robot.load(*(None if file is None else Path(file) for file in (description, measured)))


def learn(
    arm: str, wheels: str, into: str, method: str | None = None, description: str | None = None,
    measured: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Learns arm and wheels from two files of samples and writes the model to `into`.

    Returns every method's score (or that of `method` alone), learning curves and the fit of the wheels; with every
    method also the held-out error of each reading of the paper's rule that its text allows.
    """
    robot, file = load_robot(description, measured), Path(into)
    file.unlink(missing_ok=True)
    _, report = learn_arm(Path(arm), file, robot, method=method)
    _, fit = learn_wheels(Path(wheels), file, robot)
    nominal = NominalModel(robot)
    rows = dataset.read(Path(arm), HandRow, robot).rows
    learn, held = study.split(study.clean(sightings(rows), nominal))
    sizes = [size for size in SIZES if size <= len(learn)]
    draws = np.unique([row.draw for row in rows])
    readings = {
        one.name: study.rms(study.errors_m(study.fit(one.method, nominal, learn), held))
        for one in (ALLOWED if method is None else ())
    }
    trials = dataset.read(Path(wheels), WheelRow, robot).rows
    return {
        "arm": report.data(),
        "learn": len(learn),
        "held": len(held),
        "curves": {
            name: {str(s): e for s, e in zip(sizes, study.curve(m, nominal, learn, held, sizes), strict=True)}
            for name, m in CURVES.items()
        },
        "readings": readings,
        "draws_used": len(draws),
        "draws_looked_at": int(draws.max() - draws.min() + 1),
        "babbled_s": _babbled_s(rows),
        "wheels": _fitted(fit, trials),
    }


def rigid(
    arm: str, wheels: str, into: str, description: str | None = None, measured: str | None = None
) -> dict[str, Any]:  # fmt: skip
    """Calibrates the rigid body by the arm's samples, and writes a model with it and with the learned wheels. Returns
    its error."""
    robot, file = load_robot(description, measured), Path(into)
    file.unlink(missing_ok=True)
    _, report = learn_arm(Path(arm), file, robot, method=study.RIGID[-1].name)
    learn_wheels(Path(wheels), file, robot)
    return {"held_out_m": report.scores[-1].held_out_m}


def wheels(trials: str, into: str, description: str | None = None, measured: str | None = None) -> dict[str, Any]:
    """Learns the wheels alone and writes the model to `into`. Returns the fit."""
    robot, file = load_robot(description, measured), Path(into)
    file.unlink(missing_ok=True)
    _, fit = learn_wheels(Path(trials), file, robot)
    return {"wheels": _fitted(fit, dataset.read(Path(trials), WheelRow, robot).rows)}


def _fitted(fit: WheelFit, trials: Sequence[WheelRow]) -> dict[str, Any]:
    after = [fit_wheels(trials[:count]) for count in range(2, len(trials) + 1, 2)]
    return {
        "separation_m": fit.separation_m, "sigma_m": fit.sigma_m, "median_m": fit.median_m,
        "estimates_m": list(fit.estimates_m), "left_scale": fit.left_scale, "right_scale": fit.right_scale,
        "after_m": [one.separation_m if one is not None else None for one in after],
    }  # fmt: skip


def _babbled_s(rows: Sequence[HandRow]) -> float:
    """Simulated time of the babbling; each continued babbling starts its clock at 0 again."""
    steps = np.diff([row.stamp_ns for row in rows])
    return float(steps[steps > 0].sum()) / NS


def bend(
    into: str, bent: str, bend_s: float, description: str | None = None, measured: str | None = None
) -> dict[str, Any]:
    """Error of the learned map at each sighting of an arm that is bent after `bend_s`: fixed, and trained further."""
    robot = load_robot(description, measured)
    arm = model.load(Path(into), robot).arm
    if arm is None:
        raise msgspec.ValidationError(f"{into} has no model of the arm")
    fixed = model.hand_map(arm, robot)
    adapter = Adapter(model.hand_map(arm, robot), arm.training.scores["held_out_rms_m"])
    rows = dataset.read(Path(bent), HandRow, robot).rows
    seen = sightings(rows)
    return {
        "bent_at": int(np.searchsorted([row.stamp_ns for row in rows], bend_s * NS)),
        "fixed_m": study.errors_m(fixed, seen).round(5).tolist(),
        "adapted_m": [
            round(adapter.add(angles, place), 5) for angles, place in zip(seen.angles_rad, seen.places_m, strict=True)
        ],
        "changes": adapter.changes,
    }
