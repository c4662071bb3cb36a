"""Behaviour cloning in NumPy: a network that proposes the chunk of actions that followed what it sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench import policy_learned
from bench.policy_data import Episode
from bench.policy_learned import Network
from cocoro.arrays import FloatArray
from cocoro.features import PolicyFeatures

STEP, FIRST_DECAY, SECOND_DECAY = 2e-3, 0.9, 0.999
"""Of Adam (Kingma and Ba 2015), with the two decays that it proposes; the step falls to zero as a half cosine."""
BATCH = 128
LEAST_SPREAD = 0.02
"""A value that hardly changes is not blown up: rad, m, m/s, rad/s or a share."""
WEIGHT_DECAY = 1e-4


class Pairs(NamedTuple):
    """What is to be imitated."""

    inputs: FloatArray
    """Shape (rows, inputs)."""
    chunks: FloatArray
    """The actions from each row on, shape (rows, chunk * values). After an episode's end its last action goes on."""


def pairs_of(episodes: Sequence[Episode], chunk: int) -> Pairs:
    """The rows of all episodes."""
    chunks = []
    for episode in episodes:
        rows = len(episode.actions)
        ahead = np.minimum(np.arange(rows)[:, None] + np.arange(chunk), rows - 1)
        chunks.append(episode.actions[ahead].reshape(rows, -1))
    return Pairs(np.concatenate([episode.inputs for episode in episodes]), np.concatenate(chunks))


def begun(pairs: Pairs, hidden: Sequence[int], draw: np.random.Generator) -> Network:
    """A network with small random weights, scaled for the pairs."""
    sizes = [pairs.inputs.shape[1], *hidden, pairs.chunks.shape[1]]
    layers = list(pairwise(sizes))
    return Network(
        [draw.normal(0.0, inputs**-0.5, (inputs, outputs)) for inputs, outputs in layers],
        [np.zeros(outputs) for _, outputs in layers],
        pairs.inputs.mean(0),
        np.maximum(pairs.inputs.std(0), LEAST_SPREAD),
        pairs.chunks.mean(0),
        np.maximum(pairs.chunks.std(0), LEAST_SPREAD),
    )


def error(network: Network, pairs: Pairs) -> float:
    """Root mean square of what is off, in spreads of the outputs."""
    off = (network(pairs.inputs) - pairs.chunks) / network.output_spread
    return float(np.sqrt(np.mean(off**2)))


def train(
    network: Network,
    pairs: Pairs,
    steps: int,
    noise: FloatArray,
    draw: np.random.Generator,
    tell: Callable[[int], None] = lambda _step: None,
) -> None:
    """Change a network's weights by so many steps of Adam. `noise`, shape (inputs,): standard deviation of what is
    added to inputs while the actions stay: a policy that has come off the way is to go back to it."""
    values = [*network.weights, *network.biases]
    mean, square = ([np.zeros_like(value) for value in values] for _ in range(2))
    wanted = (pairs.chunks - network.output_mean) / network.output_spread
    for step in range(1, steps + 1):
        rows = draw.integers(len(pairs.inputs), size=BATCH)
        seen = pairs.inputs[rows] + noise * draw.standard_normal((BATCH, len(noise)))
        slopes = _slopes(network, (seen - network.input_mean) / network.input_spread, wanted[rows])
        pace = STEP * 0.5 * (1.0 + np.cos(np.pi * step / steps))
        for value, slope, first, second in zip(values, slopes, mean, square, strict=True):
            first += (1.0 - FIRST_DECAY) * (slope - first)
            second += (1.0 - SECOND_DECAY) * (slope**2 - second)
            way = first / (1.0 - FIRST_DECAY**step) / (np.sqrt(second / (1.0 - SECOND_DECAY**step)) + 1e-8)
            value -= pace * (way + WEIGHT_DECAY * value)
        tell(step)


def _slopes(network: Network, inputs: FloatArray, wanted: FloatArray) -> list[FloatArray]:
    """Gradient of half the mean square error by all weights, then by all biases; all scaled."""
    outputs = [inputs]
    for number, (weights, biases) in enumerate(zip(network.weights, network.biases, strict=True)):
        values = outputs[-1] @ weights + biases
        outputs.append(np.tanh(values) if number + 1 < len(network.weights) else values)
    back = (outputs[-1] - wanted) / len(inputs)
    by_weights: list[FloatArray] = []
    by_biases: list[FloatArray] = []
    for number in reversed(range(len(network.weights))):
        by_weights.insert(0, outputs[number].T @ back)
        by_biases.insert(0, back.sum(0))
        if number:
            back = (back @ network.weights[number].T) * (1.0 - outputs[number] ** 2)
    return [*by_weights, *by_biases]


def write(folder: Path, name: str, network: Network, features: PolicyFeatures) -> str:
    """Write a policy into a folder, as NAME.npz and NAME.py. Returns what a task names it by."""
    layers = {
        f"{kind}_{number}": values
        for kind in ("weights", "biases")
        for number, values in enumerate(getattr(network, kind))
    }
    scales = {field: getattr(network, field) for field in Network._fields[2:]}
    said = {field: getattr(features, field) for field in ("rate_hz", "chunk", "every", "width", "height", "robot")}
    kept: dict[str, Any] = {
        "layers": len(network.weights),
        "names": np.array(features.state),
        **said,
        **layers,
        **scales,
    }
    np.savez(folder / f"{name}.npz", **kept)
    program = folder / f"{name}.py"
    make = f'def {name}(robot: Robot) -> Learned:\n    return Learned(robot, Path(__file__).with_suffix(".npz"))\n'
    program.write_text(f"{Path(policy_learned.__file__).read_text(encoding='utf-8')}\n\n{make}", encoding="utf-8")
    return f"{program}:{name}"
