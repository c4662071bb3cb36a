"""A policy that was learned by imitation, as the service `policy` runs it: what it looks at, and its network.

A copy of this file lies beside the weights (NumPy's .npz) of each policy that the bench writes, with a callable that
reads them: so it needs nothing of the bench. What the network gets of a picture is where the red in it is, and how
much; of the state, the joint angles. It gets no speeds: one that does learns to go on as it goes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.features import PICTURES, STATE, PolicyFeatures
from cocoro.policy import Observation
from cocoro.robot import Robot

RED_FROM, RED_OVER, LIT = 0.5, 0.25, 60.0
"""A pixel is red by the share of its red that exceeds both other colours: not at all below the first, fully so much
above it. In a dark one, of so much red, of 255, noise has every colour. Pink, as a marker is, is no red."""
LEAST_PX = 1.5
"""Of red; with less nothing red is seen."""
ANGLE_NOISE_RAD = 0.03
SEEN_NOISE = (0.0, 0.02, 0.02, 0.02, 0.02, 0.01, 0.005, 0.005, 0.005)
"""What is added in training to the values that a picture becomes, standard deviations."""
LOWEST = 0.15
"""A line of sight that falls by less than this is taken to fall by so much."""


class Network(NamedTuple):
    """Layers of tanh, the last one linear. Inputs and outputs are scaled by mean and spread."""

    weights: list[FloatArray]
    """Of each layer, shape (inputs, outputs)."""
    biases: list[FloatArray]
    input_mean: FloatArray
    input_spread: FloatArray
    output_mean: FloatArray
    output_spread: FloatArray

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Outputs, shape (rows, outputs), of inputs, shape (rows, inputs)."""
        values = (inputs - self.input_mean) / self.input_spread
        for number, (weights, biases) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = values @ weights + biases
            if number + 1 < len(self.weights):
                values = np.tanh(values)
        return values * self.output_spread + self.output_mean


class Look:
    """Makes the network's inputs of observations."""

    def __init__(self, robot: Robot, width: int, height: int) -> None:
        self._joints = [*robot.joints]
        self._chain = robot.camera_chain
        self._camera = robot.camera.scaled(width, height)
        self._size_px = np.array([width, height], np.float64)
        self._u, self._v = (axis.astype(np.float64) for axis in np.meshgrid(np.arange(width), np.arange(height)))

    def __call__(self, state: Float32Array, picture: ImageArray) -> FloatArray:
        """Of one observation, shape (joints + 9,): the angles, rad; whether red is seen, 0 or 1; where the lines of
        sight through its middle and its lower edge meet the floor, body frame, m, x and y of each; the middle's place
        in the picture, its spread, and the amount of red, as shares of the picture's sides."""
        angles = state[: len(self._joints)].astype(np.float64)
        return np.concatenate([angles, self._seen(dict(zip(self._joints, angles.tolist(), strict=True)), picture)])

    @property
    def noise(self) -> FloatArray:
        """Standard deviations of what is added to inputs in training, in the inputs' units."""
        return np.array([*(ANGLE_NOISE_RAD for _ in self._joints), *SEEN_NOISE])

    def _seen(self, angles: dict[str, float], picture: ImageArray) -> FloatArray:
        colours = picture.astype(np.float64)
        share = 1.0 - np.maximum(colours[..., 1], colours[..., 2]) / np.maximum(colours[..., 0], LIT)
        red = np.where(colours[..., 0] < LIT, 0.0, np.clip((share - RED_FROM) / RED_OVER, 0.0, 1.0))
        amount = float(red.sum())
        if amount < LEAST_PX:
            return np.zeros(len(SEEN_NOISE))
        u, v = float((red * self._u).sum() / amount), float((red * self._v).sum() / amount)
        wide = float((red * (self._u - u) ** 2).sum() / amount) ** 0.5
        high = float((red * (self._v - v) ** 2).sum() / amount) ** 0.5
        pose = self._chain.pose(angles)
        middle, foot = (self._on_floor(pose, u, down) for down in (v, v + 1.7 * high))
        width, height = self._size_px
        return np.array(
            [1.0, *middle, *foot, v / height, wide / width, high / height, (amount / width / height) ** 0.5]
        )

    def _on_floor(self, pose: FloatArray, u_px: float, v_px: float) -> tuple[float, float]:
        ray = pose[:3, :3] @ self._camera.ray(u_px, v_px)
        ray /= np.linalg.norm(ray)
        x, y, _ = pose[:3, 3] + ray * (pose[2, 3] / max(-float(ray[2]), LOWEST))
        return float(x), float(y)


class Learned:
    """The policy of a file of weights."""

    def __init__(self, robot: Robot, path: Path) -> None:
        with np.load(path) as kept:
            layers = int(kept["layers"])
            self.features = PolicyFeatures(
                state=tuple(kept["names"].tolist()), action=tuple(kept["names"].tolist()),
                rate_hz=float(kept["rate_hz"]), chunk=int(kept["chunk"]), every=int(kept["every"]),
                width=int(kept["width"]), height=int(kept["height"]), robot=str(kept["robot"]),
            )  # fmt: skip
            self._network = Network(
                [kept[f"weights_{number}"] for number in range(layers)],
                [kept[f"biases_{number}"] for number in range(layers)],
                *(kept[name] for name in Network._fields[2:]),
            )
        self._look = Look(robot, int(self.features.width or 0), int(self.features.height or 0))

    def reset(self) -> None:
        """It has no memory."""

    def act(self, observation: Observation) -> FloatArray:
        inputs = self._look(observation[STATE], observation[PICTURES])
        rows: FloatArray = self._network(inputs[None])[0].reshape(self.features.chunk, -1)
        return rows
