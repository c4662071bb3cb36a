"""What is asked of a base's wheels, and for how long: the age of commands and the emergency stop, whatever drives them.
Pure."""

from __future__ import annotations

from collections.abc import Sequence

from cocoro.base import Base
from cocoro.clock import NS, is_fresh
from cocoro.messages import BaseCommand, LatchState
from cocoro.messages.hardware import STOPPED_BY
from cocoro.topics import BASE_COMMAND


class WheelCommands:
    """The newest command, as speeds of the wheels. Every `now_ns` is the robot's clock."""

    def __init__(self, base: Base) -> None:
        self.latch: LatchState = "unknown"
        self._base = base
        self._drive = base.drive
        self._rest = (0.0,) * len(self._drive.names)
        self._timeout_ns = round(base.command_timeout_s * NS)
        self._wanted_mps: Sequence[float] = self._rest
        self._until_ns = -1

    def command(self, command: BaseCommand, now_ns: int) -> None:
        """Accept speeds, but none that the base cannot drive at: such a command is not obeyed, and the one before it
        expires. They expire `Base.patience_s` after the command's stamp, the sooner the faster."""
        if self.latch != "released" or not is_fresh(command.stamp_ns, now_ns, BASE_COMMAND.max_age_s):
            return
        try:
            self._wanted_mps = self._within(self._drive.wheels_of(command))
        except ValueError:
            return
        patience_s = self._base.patience_s(fastest_mps(self._wanted_mps))
        self._until_ns = min(command.stamp_ns, now_ns) + round(patience_s * NS)

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown stop the wheels; a release does not revive an earlier command. Thread-safe."""
        self.latch = state
        self._until_ns = -1

    def new_epoch(self) -> None:
        """The clock restarted: an earlier command belongs to no time of the new epoch."""
        self._until_ns = -1

    def wheels(self, now_ns: int) -> tuple[Sequence[float], int]:
        """By wheel its speed, m/s, and for how long from now, ns."""
        left_ns = self._until_ns - now_ns
        if self.latch != "released" or left_ns < 0:
            return self._rest, self._timeout_ns
        return self._wanted_mps, min(left_ns, self._timeout_ns)

    def stopped_by(self, now_ns: int) -> str:
        """`BaseState.stopped_by`, as far as stop and commands determine it."""
        return STOPPED_BY[self.latch] or ("no command" if now_ns > self._until_ns else "")

    def _within(self, wheels_mps: Sequence[float]) -> Sequence[float]:
        """The speeds within the limit: of wheels in step all by one share, of others each by itself."""
        limit_mps, most_mps = self._base.max_wheel_speed_mps, fastest_mps(wheels_mps)
        if self._drive.in_step:
            share = min(limit_mps / most_mps, 1.0) if most_mps else 1.0
            return [share * speed_mps for speed_mps in wheels_mps]
        return [min(max(speed_mps, -limit_mps), limit_mps) for speed_mps in wheels_mps]


def fastest_mps(wheels_mps: Sequence[float]) -> float:
    """Speed of the fastest wheel, without its sign."""
    return max(abs(speed_mps) for speed_mps in wheels_mps)
