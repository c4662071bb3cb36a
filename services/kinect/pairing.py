"""Which colour picture belongs to which depth picture, and when they were taken. Pure.

The Kinect's two cameras run freely at 30 Hz each and stamp their pictures by the device's own clock. Those stamps have
no jitter but also no relation to anybody else's time; the time at which a picture arrives here has both.
"""

from __future__ import annotations

from typing import NamedTuple

from services.kinect.freenect import TICKS_HZ, Kind

NS = 1_000_000_000
PERIOD_NS = NS // 30
TOLERANCE_NS = round(0.55 * PERIOD_NS)
"""Of two free-running streams of one rate, one picture at least is nearer than half a period; and some jitter."""
DRIFT = 100e-6
"""How much slower than ours the device's clock may be: quartzes are within 50 ppm each."""
ANEW_NS = NS // 5
"""What comes so much later than expected says that the device's clock began anew (or that it stands)."""
WRAP = 1 << 32
WAITING = 2
"""Pictures of one kind that wait for their partner at most."""


class DeviceClock:
    """One stream's stamps by our monotonic clock: as if each picture had come as fast as the fastest."""

    def __init__(self) -> None:
        self._ticks: int | None = None
        self._device_ns = 0.0
        self._offset_ns = 0.0

    def at(self, ticks: int, arrival_ns: int) -> int:
        """When a picture would have arrived without delay, ns, by the clock that `arrival_ns` goes by."""
        if self._ticks is None:
            self._offset_ns = arrival_ns - self._device_ns
        else:
            passed = (ticks - self._ticks + WRAP // 2) % WRAP - WRAP // 2
            passed_ns = passed * NS / TICKS_HZ
            self._device_ns += passed_ns
            self._offset_ns += abs(passed_ns) * DRIFT
        self._ticks = ticks
        seen_ns = arrival_ns - self._device_ns
        if seen_ns < self._offset_ns or seen_ns - self._offset_ns > ANEW_NS:
            self._offset_ns = seen_ns
        return round(self._device_ns + self._offset_ns)


class Picture(NamedTuple):
    """One picture in its buffer."""

    at_ns: int
    buffer: int


class Pair(NamedTuple):
    colour: Picture
    depth: Picture


class Pairer:
    """Told of every picture; gives pairs, and the buffers of pictures that will be in none."""

    def __init__(self) -> None:
        self._waiting: dict[Kind, list[Picture]] = {"colour": [], "depth": []}

    def add(self, kind: Kind, picture: Picture) -> tuple[Pair | None, list[tuple[Kind, int]]]:
        """The pair that this picture completes, and the buffers that are free now, with their kinds."""
        other: Kind = "depth" if kind == "colour" else "colour"
        near = min(self._waiting[other], key=lambda waiting: abs(waiting.at_ns - picture.at_ns), default=None)
        if near is None or abs(near.at_ns - picture.at_ns) > TOLERANCE_NS:
            waiting = self._waiting[kind]
            waiting.append(picture)
            return None, [(kind, waiting.pop(0).buffer)] if len(waiting) > WAITING else []
        self._waiting[other].remove(near)
        pair = Pair(picture, near) if kind == "colour" else Pair(near, picture)
        free: list[tuple[Kind, int]] = []
        for each, waiting in self._waiting.items():
            # What is older than a pair has missed its partner.
            own_ns = (pair.colour if each == "colour" else pair.depth).at_ns
            free += [(each, one.buffer) for one in waiting if one.at_ns < own_ns]
            waiting[:] = [one for one in waiting if one.at_ns >= own_ns]
        return pair, free
