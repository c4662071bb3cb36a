"""Target memory: where each known object is, in the odometry frame, and how it moves.

One constant-velocity Kalman filter (Kalman 1960) per object, equal for the three axes. Sightings enter with the time of
their frame. Positions are in the odometry frame, so odometry carries an object that is not seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, hypot

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import TargetEstimate
from cocoro.units import Vec3
from services.planning.config import MemoryConfig

_SURE = 3
"""Sightings after which an object counts as existing."""
_ONE_PLACE_M = 0.05
"""Two objects whose middles are nearer than this along each axis are one object, seen under two labels."""
_AGREE = 3
"""Consecutive outliers in agreement that move the object to their position."""


@dataclass
class Track:
    """One object's filter. Positions (3,): odometry frame, metres; `covariance` (2, 2): position and velocity."""

    position_m: FloatArray
    stamp_ns: int
    sigma_m: float
    velocity_mps: FloatArray = field(default_factory=lambda: np.zeros(3))
    covariance: FloatArray = field(default_factory=lambda: np.diag([1e-4, 1e-2]))
    sightings: int = 1
    whole: int = 0
    """How many of them showed it whole."""
    surprise: float = 1.0
    """Smoothed normalised innovation; above 1 the object moves more than expected."""
    outliers: list[FloatArray] = field(default_factory=list)
    common_m: float = 0.0
    """Standard deviation of what the newest sightings' errors have in common, which no mean of them makes smaller."""
    body: Pose2 = field(default_factory=Pose2)
    """Where the robot was at the newest sighting, odometry frame."""


class TargetMemory:
    def __init__(self, config: MemoryConfig) -> None:
        self._config = config
        self._tracks: dict[str, Track] = {}
        self.sight_lag_s = 0.0
        """Usual age of a sighting when the next one arrives. Up to that age an object goes on as it went; only one that
        should have been seen again loses its velocity."""
        self._estimates: dict[str, TargetEstimate] = {}
        """What was told for `_asked`, since one step asks for the same objects several times."""
        self._asked: tuple[Pose2, int, float] | None = None
        """The body's pose, the time and `sight_lag_s`."""

    def clear(self) -> None:
        self._estimates.clear()
        self._tracks.clear()

    def forget(self, label: str) -> None:
        self._estimates.clear()
        self._tracks.pop(label, None)

    def see(
        self,
        label: str,
        position_m: FloatArray,
        distance_m: float,
        stamp_ns: int,
        *,
        doubtful: bool,
        body: Pose2 | None = None,
        own_sigma_m: float | None = None,
    ) -> None:
        """Enter a sighting: the object's centre (3,), odometry frame, metres, at the frame's stamp, seen from the
        body's pose; None: the body has not moved since the last. `own_sigma_m`: its standard deviation, if perception
        tells it; several such sightings are no surer than the surest of them."""
        self._estimates.clear()
        config = self._config
        sigma_m = own_sigma_m if own_sigma_m is not None else config.sigma_m + config.sigma_per_m * distance_m
        if doubtful:
            sigma_m *= config.doubtful_factor
        track = self._tracks.get(label)
        if doubtful and self._of_another(label, position_m):
            return
        if track is None or (stamp_ns - track.stamp_ns) / NS > config.forget_s:
            track = Track(position_m.copy(), stamp_ns, sigma_m, whole=not doubtful, body=body or Pose2())
            track.common_m = sigma_m if own_sigma_m is not None else 0.0
            self._tracks[label] = track
            return
        body = body or track.body
        dt_s = (stamp_ns - track.stamp_ns) / NS
        if dt_s < 0:
            return
        predicted = self._moved(track, dt_s)
        off_m = float(np.linalg.norm(position_m - predicted))
        drift_m = self._drift_m(track, body, predicted)
        spread_m = float(np.sqrt(track.covariance[0, 0] + drift_m**2 + (0.1 * dt_s) ** 2) + sigma_m)
        if off_m > max(config.gate_sigmas * spread_m, config.gate_m):
            self._outlier(label, track, position_m, stamp_ns, sigma_m, body, doubtful)
            return
        track.outliers.clear()
        track.covariance[0, 0] += drift_m**2
        self._update(track, predicted, position_m, dt_s, sigma_m)
        # Far sightings say little of a near one's error, which counts from then on; a doubtful one does not worsen it.
        if own_sigma_m is not None:
            track.common_m = min(track.common_m, sigma_m) if doubtful and track.common_m else sigma_m
        track.body = body
        track.stamp_ns = stamp_ns
        track.sightings += 1
        track.whole += not doubtful
        if track.sightings >= _SURE:
            self._forget_mistaken(label, track)

    def _of_another(self, label: str, position_m: FloatArray) -> bool:
        """Whether a sighting (3,), odometry frame, m, that showed an object in part may show part of another one: one
        that stands there, and that more sightings showed whole. A can that the hand half hides looks like a ball."""
        track = self._tracks.get(label)
        own = track.whole if track is not None else 0
        return any(
            other != label and was.whole > own and np.abs(was.position_m - position_m).max() < _ONE_PLACE_M
            for other, was in self._tracks.items()
        )

    def _forget_mistaken(self, label: str, track: Track) -> None:
        """Forget what was seen in an object's place before under another label: from far or in part, a can may look
        like a ball. It would be an obstacle in the object's own place."""
        mistaken = [
            other
            for other, was in self._tracks.items()
            if other != label
            and was.stamp_ns < track.stamp_ns
            and np.abs(was.position_m - track.position_m).max() < _ONE_PLACE_M
        ]
        for other in mistaken:
            del self._tracks[other]

    def _drift_m(self, track: Track, body: Pose2, place_m: FloatArray) -> float:
        """By how much odometry may have displaced a place (3,), odometry frame, m, since the object's newest sighting
        (derived): an error of heading turns the place about the robot, and what was driven on in that heading."""
        way = track.body.inverse().compose(body)
        driven_m, away_m = hypot(way.x_m, way.y_m), hypot(place_m[0] - body.x_m, place_m[1] - body.y_m)
        config = self._config
        turn_rad = config.drift_rad_per_m * driven_m + config.drift_share * abs(way.yaw_rad)
        return hypot(turn_rad * (away_m + driven_m / 2), config.drift_share * driven_m)

    def _update(self, track: Track, predicted: FloatArray, seen: FloatArray, dt_s: float, sigma_m: float) -> None:
        unseen_s = max(dt_s - max(self.sight_lag_s, 0.2), 0.0)
        fade = exp(-unseen_s / self._config.velocity_fade_s)
        q = self._config.acceleration_mps2**2 * max(track.surprise, 1.0) ** 2
        step = np.array([[1.0, dt_s], [0.0, fade]])
        noise = q * np.array([[dt_s**4 / 4, dt_s**3 / 2], [dt_s**3 / 2, dt_s**2]])
        covariance = step @ track.covariance @ step.T + noise
        variance = covariance[0, 0] + sigma_m**2
        innovation = seen - predicted
        normalised = float(innovation @ innovation) / 3.0 / variance
        track.surprise += 0.15 * (min(normalised, 25.0) - track.surprise)
        gain = covariance[:, 0] / variance
        track.position_m = predicted + gain[0] * innovation
        track.velocity_mps = fade * track.velocity_mps + gain[1] * innovation
        track.covariance = covariance - np.outer(gain, covariance[0])
        track.sigma_m = float(np.sqrt(track.covariance[0, 0]))

    def _outlier(
        self,
        label: str,
        track: Track,
        position_m: FloatArray,
        stamp_ns: int,
        sigma_m: float,
        body: Pose2,
        doubtful: bool,
    ) -> None:
        """A sighting far from the expected position: another object, or this one was moved."""
        if doubtful:
            return
        if track.outliers and np.linalg.norm(position_m - track.outliers[-1]) > 2 * self._config.gate_m:
            track.outliers.clear()
        track.outliers.append(position_m.copy())
        if len(track.outliers) >= _AGREE:
            moved = Track(np.mean(track.outliers, axis=0), stamp_ns, sigma_m, body=body)
            moved.common_m = sigma_m if track.common_m else 0.0
            self._tracks[label] = moved

    def estimate(self, label: str, body: Pose2, now_ns: int) -> TargetEstimate | None:
        """The estimate of an object now, in the frame of the body's pose; None for an unknown one."""
        track = self._tracks.get(label)
        if track is None:
            return None
        asked = (body, now_ns, self.sight_lag_s)
        if asked != self._asked:
            self._asked = asked
            self._estimates.clear()
        if label not in self._estimates:
            estimate = self._estimate(label, track, body, now_ns)
            if estimate is None:
                return None
            self._estimates[label] = estimate
        return self._estimates[label]

    def _estimate(self, label: str, track: Track, body: Pose2, now_ns: int) -> TargetEstimate | None:
        age_s = max((now_ns - track.stamp_ns) / NS, 0.0)
        if age_s > self._config.forget_s:
            del self._tracks[label]
            return None
        position = self._now(track, age_s)
        return TargetEstimate(
            label=label,
            position_m=body.inverse().apply(position.tolist()),
            velocity_mps=(float(track.velocity_mps[0]), float(track.velocity_mps[1]), float(track.velocity_mps[2])),
            sigma_m=float(
                hypot(max(track.sigma_m, track.common_m), 0.01 * age_s, self._drift_m(track, body, position))
            ),
            age_s=age_s,
            odometry_position_m=(float(position[0]), float(position[1]), float(position[2])),
        )

    def sure(self, label: str) -> bool:
        """Whether an object was seen repeatedly; one sighting may be a mistake."""
        return self.sightings(label) >= _SURE

    def place(self, label: str, stamp_ns: int, within_s: float) -> Vec3 | None:
        """The position of a sure object at a time, odometry frame, m; None when its newest sighting is further off than
        `within_s`."""
        track = self._tracks.get(label)
        if track is None or not self.sure(label) or abs(stamp_ns - track.stamp_ns) > within_s * NS:
            return None
        x, y, z = self._now(track, max((stamp_ns - track.stamp_ns) / NS, 0.0)).tolist()
        return x, y, z

    def sightings(self, label: str) -> int:
        """Number of sightings that support the object's position."""
        track = self._tracks.get(label)
        return track.sightings if track else 0

    def whole(self, label: str) -> int:
        """Number of the sightings that showed an object whole."""
        track = self._tracks.get(label)
        return track.whole if track else 0

    def all(self, body: Pose2, now_ns: int, *, sure: bool = False) -> tuple[TargetEstimate, ...]:
        """The estimates of all objects; `sure`: only of those that were seen repeatedly, since one sighting may be a
        mistake."""
        least = _SURE if sure else 1
        labels = [label for label, track in sorted(self._tracks.items()) if track.sightings >= least]
        found = (self.estimate(label, body, now_ns) for label in labels)
        return tuple(estimate for estimate in found if estimate is not None)

    def _now(self, track: Track, age_s: float) -> FloatArray:
        """The position (3,) that counts `age_s` after the newest sighting. A velocity counts in full from twice its
        standard deviation on, and not at all within one: two sightings of something that stands, by a slow
        perception, would else send it away."""
        power, noise = float(track.velocity_mps @ track.velocity_mps), 3.0 * float(track.covariance[1, 1])
        weight = min(max((power / noise - 1.0) / 3.0, 0.0), 1.0)
        return track.position_m + weight * (self._moved(track, age_s) - track.position_m)

    def _moved(self, track: Track, dt_s: float) -> FloatArray:
        """The position (3,) after `dt_s`. Beyond the usual lag the velocity decays: integral of v exp(-t / fade)."""
        fade_s, known_s = self._config.velocity_fade_s, min(dt_s, self.sight_lag_s)
        return track.position_m + track.velocity_mps * (known_s + fade_s * (1.0 - exp(-(dt_s - known_s) / fade_s)))
