"""How arm and hand were at a time."""

from __future__ import annotations

from collections.abc import Collection

from cocoro.clock import NS
from cocoro.history import History
from cocoro.messages import ServoState

_STATES = 256
"""States of a network that are kept: 5 s, so that a slow perception's frames find theirs."""
_JUST_NS = NS // 25
"""Age of the newest state up to which it counts for a time after it: two periods of the servos."""


class PostureHistory:
    def __init__(self, joints: Collection[str], gap_ns: int) -> None:
        """`joints`: all that the robot has. `gap_ns`: longest gap over which angles are interpolated."""
        self._joints = frozenset(joints)
        self._gap_ns = gap_ns
        self._networks: dict[str, tuple[tuple[str, ...], History]] = {}

    def add(self, network: str, state: ServoState) -> None:
        joints, history = self._networks.get(network, ((), None))
        if history is None or joints != state.joints:
            history = History(len(state.joints), capacity=_STATES)
            self._networks[network] = state.joints, history
        history.add(state.stamp_ns, state.position_rad, state.incarnation)

    @property
    def restarts(self) -> int:
        """How often the publisher of one of them, or its clock, began anew."""
        return sum(history.resets for _, history in self._networks.values())

    def near(self, stamp_ns: int) -> dict[str, float]:
        """The angles, rad, at a time by joint, without those of a network whose angles then are not in the history."""
        angles: dict[str, float] = {}
        for joints, history in self._networks.values():
            then = history.at(stamp_ns, self._gap_ns)
            if then is not None:
                angles.update(zip(joints, then.tolist(), strict=True))
        return angles

    def at(self, stamp_ns: int) -> dict[str, float] | None:
        """Every joint's angle, rad, at a time; None where that time is not in the history."""
        angles = self.near(stamp_ns)
        return angles if angles.keys() >= self._joints else None

    def known(self, stamp_ns: int) -> bool:
        """Whether it is known how all were at a time, or just before it."""
        for _, history in self._networks.values():
            newest = history.newest
            just_before = newest is not None and 0 <= stamp_ns - newest[0] <= _JUST_NS
            if not just_before and history.at(stamp_ns, self._gap_ns) is None:
                return False
        return True
