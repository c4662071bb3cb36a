"""Room for the arm to unfold: it swings over the floor beside the robot, and what stands there must be low or known."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from services.planning.config import NavigationConfig
from services.planning.surroundings import Fields, placed

_MOST = 3
"""Times that one drive goes to another place for its room."""
_LOOK_NS = 3 * NS // 2
"""Time for which the camera looks at what is in the way before the robot gives up: it may be gone."""
_SPARE_M = 0.04
"""More room than needed, for the robot does not come to a place exactly."""
NOT_HERE = "no room to unfold the arm"


class Unfolding:
    """The room that the folded arm needs on one drive, and where the robot goes for it."""

    def __init__(self, config: NavigationConfig, swing_m: FloatArray | None) -> None:
        """`swing_m`: floor positions (n, 2), body frame, metres, that the arm sweeps; None: it does not unfold."""
        self._config, self._swing = config, swing_m
        self._times = 0
        self._leaving = False
        self._none_since_ns: int | None = None

    def roomy(self, pose: Pose2, fields: Fields, spare_m: float = 0.0) -> bool:
        """Whether the arm can unfold at a pose, odometry frame, without touching a known obstacle."""
        if self._swing is None:
            return True
        return bool((fields.arm.at(placed(self._swing, pose)) > self._config.swing_room_m + spare_m).all())

    def roomy_on(self, poses: list[Pose2], fields: Fields) -> bool:
        """Whether there is room on a way before the arm must be extended."""
        end = poses[-1]
        early = [p for p in poses if hypot(p.x_m - end.x_m, p.y_m - end.y_m) >= self._config.unfold_by_m] or poses[:1]
        return any(self.roomy(pose, fields) for pose in early[:: max(len(early) // 6, 1)])

    def in_the_way(self, pose: Pose2, fields: Fields) -> tuple[float, float] | None:
        """The place under the swing that is nearest to an obstacle, odometry frame, m; None where there is room."""
        if self._swing is None or self.roomy(pose, fields):
            return None
        places = placed(self._swing, pose)
        x, y = places[int(fields.arm.at(places).argmin())].tolist()
        return x, y

    # --- going to where there is room -------------------------------------------------------------

    @property
    def tries(self) -> Sequence[tuple[float, float]]:
        """Lengths of the last stretch, m, with the room to spare at its beginning, m, in the order in which the course
        looks for a way. A robot that has come to its target in vain takes a longer or shorter one, too."""
        usual_m = self._config.last_stretch_m
        if not self._leaving:
            return ((usual_m, 0.0),)
        return ((usual_m, _SPARE_M), (usual_m, 0.0), (1.5 * usual_m, 0.0), (self._config.unfold_by_m, 0.0))

    def leave(self) -> bool:
        """The robot is at its target and has no room there: whether it may go elsewhere. Told again until
        `gone_on` is called."""
        if not self._leaving:
            self._times += 1
        self._leaving = True
        return self._times <= _MOST

    def gone_on(self) -> None:
        """The robot is at a place from which the last stretch begins."""
        self._leaving, self._none_since_ns = False, None

    def given_up(self, now_ns: int) -> bool:
        """No other place was found: whether that is so for good, after a look at what is in the way."""
        if self._none_since_ns is None:
            self._none_since_ns = now_ns
        return self._times > _MOST or now_ns - self._none_since_ns > _LOOK_NS

    def why_not(self, body: Pose2, place_m: tuple[float, float]) -> str:
        """The reason for people: what is in the way, and that there is no other way."""
        x, y, _ = body.inverse().apply((*place_m, 0.0))
        side = "left" if y >= 0 else "right"
        where = f"something stands {abs(x):.2f} m {'ahead' if x >= 0 else 'behind'} and {abs(y):.2f} m to the {side}"
        after = f" after {_MOST} other places" if self._times > _MOST else ", nor a way to where there is"
        return f"{NOT_HERE}: {where}{after}"
