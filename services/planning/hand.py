"""The claws: one degree of freedom, both together; and whether they hold something."""

from __future__ import annotations

from cocoro.messages import ServoCommand, ServoState
from cocoro.robot import Robot
from services.planning.config import Hand

CLAWS = ("claw_left", "claw_right")


class Grip:
    def __init__(self, robot: Robot, config: Hand) -> None:
        self._config = config
        self._opens = robot.claw.open_sign
        self.goal_rad: float | None = None
        """Opening angle that is commanded to both claws; None leaves them as they are."""
        self._held_since_ns: int | None = None

    def open(self) -> None:
        self.goal_rad = self._config.open_rad

    def close(self) -> None:
        """Close on whatever is there: past contact, so that the claws press."""
        self.goal_rad = -self._config.squeeze_rad

    def keep(self) -> None:
        """Leave the claws as they are."""
        self.goal_rad = None

    def command(self, roll_rad: float | None) -> ServoCommand:
        joints: list[str] = []
        goals: list[float] = []
        speeds: list[float] = []
        if roll_rad is not None:
            joints.append("wrist_roll")
            goals.append(roll_rad)
            speeds.append(2.5)
        if self.goal_rad is not None:
            for name in CLAWS:
                joints.append(name)
                goals.append(self._opens[name] * self.goal_rad)
                speeds.append(self._config.speed_radps)
        return ServoCommand(joints=tuple(joints), goal_rad=tuple(goals), speed_radps=tuple(speeds))

    def opening(self, hand: ServoState) -> tuple[float, float]:
        """The opening angles of both claws, radians, from the measured positions."""
        place = dict(zip(hand.joints, hand.position_rad, strict=True))
        left, right = (self._opens[name] * place[name] for name in CLAWS)
        return left, right

    def opened(self, hand: ServoState) -> bool:
        return min(self.opening(hand)) > self._config.open_rad - 0.08

    def feel(self, hand: ServoState, now_ns: int) -> None:
        """Take a measurement; a hold must last to count."""
        pressed = all(self._pressing(hand, name) for name in CLAWS)
        stopped_short = sum(self.opening(hand)) > 2 * (0.06 - self._config.squeeze_rad)
        if pressed and stopped_short:
            if self._held_since_ns is None:
                self._held_since_ns = now_ns
        else:
            self._held_since_ns = None

    def holding(self, now_ns: int) -> bool:
        """The claws have been stopped by something for long enough."""
        return self._held_since_ns is not None and (now_ns - self._held_since_ns) / 1e9 >= self._config.settle_s

    def _pressing(self, hand: ServoState, name: str) -> bool:
        i = hand.joints.index(name)
        closing_load = -self._opens[name] * hand.load[i]
        return closing_load >= self._config.grip_load and abs(hand.speed_radps[i]) < 0.25
