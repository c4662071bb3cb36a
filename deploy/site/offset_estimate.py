"""Estimates how far a clock is ahead of this machine's, from questions over a network: pure, no clock, no I/O.

Each exchange has four stamps: sent and back by this machine's steady clock, received and answered by the other's time.
The true difference lies within half the round trip of what they say, however unlike the two ways are. So the exchange
with the shortest round trip says most, and one that is old says less, for the clocks drift. The drift is the median of
the slopes between the best exchanges of some minutes (Theil and Sen), which single bad ones do not move.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import NamedTuple

from cocoro.clock import NS

PPM = 1e-6
UNKNOWN_PPM = 100.0
"""Bound of the drift between two clocks before it has been observed; quartz is within 50 ppm."""
KNOWN_PPM = 15.0
"""Bound of what the drift may differ from the observed one, as NTP assumes it: clocks warm up, and are slewed."""
KEPT_NS = 16 * NS
"""Exchanges of this time are candidates for the offset."""
SLOT_NS = 4 * NS
"""The best exchange of each such time enters the drift."""
SLOTS = 64
"""Of these there are so many: four minutes."""
FEWEST_SLOTS = 8
"""The drift counts as observed from so many on, if the jitter of the round trips hides less than `KNOWN_PPM`."""
ANEW_AFTER = 3
"""So many exchanges in a row that contradict the estimate and agree with each other begin it anew: a clock was set."""


class Sample(NamedTuple):
    """What one exchange says."""

    at_ns: int
    """Its middle, by this machine's steady clock."""
    ahead_ns: int
    """The other's time minus this machine's steady clock then."""
    round_trip_ns: int

    @property
    def doubt_ns(self) -> float:
        return self.round_trip_ns / 2


def sample(sent_ns: int, received_ns: int, answered_ns: int, back_ns: int) -> Sample | None:
    """From four stamps; None when they contradict themselves."""
    round_trip_ns = (back_ns - sent_ns) - (answered_ns - received_ns)
    if answered_ns < received_ns or round_trip_ns < 0:
        return None
    ahead_ns = ((received_ns - sent_ns) + (answered_ns - back_ns)) // 2
    return Sample((sent_ns + back_ns) // 2, ahead_ns, round_trip_ns)


class Estimate(NamedTuple):
    """The other's time relative to this machine's steady clock, at one moment."""

    ahead_ns: float
    uncertainty_ns: float
    """The truth is within this of `ahead_ns`, if no clock was set since and the drift is within its bound."""
    slope: float
    """Seconds that `ahead_ns` grows per second; 0 before it was observed."""
    slope_known: bool
    round_trip_ns: int
    """Of the exchange that it rests on."""


class OffsetEstimator:
    """Add samples, and ask `at` any time."""

    def __init__(self) -> None:
        self._kept: deque[Sample] = deque()
        self._slots: deque[Sample] = deque(maxlen=SLOTS)
        """The best sample of each slot, oldest first; the last is of the present slot."""
        self._slot_ns = 0
        self._slope: float | None = None
        self._doubted: list[Sample] = []
        self.restarts = 0
        """How often a clock was set, as far as the samples show."""

    def add(self, new: Sample) -> None:
        """Takes a sample; one that contradicts the estimate counts only if the next ones agree with it."""
        if self._contradicts(new):
            self._doubted = [old for old in self._doubted if _agree(old, new)] + [new]
            if len(self._doubted) < ANEW_AFTER:
                return
            begun = self._doubted
            self._kept.clear()
            self._slots.clear()
            self._slope = None
            self.restarts += 1
        else:
            begun = [new]
        self._doubted = []
        for one in begun:
            self._take(one)

    def at(self, now_ns: int) -> Estimate | None:
        """The estimate at a time of the steady clock; None before the first sample."""
        if not self._kept:
            return None
        bound = (UNKNOWN_PPM if self._slope is None else KNOWN_PPM) * PPM
        slope = self._slope or 0.0
        doubt_ns, best = min((one.doubt_ns + bound * abs(now_ns - one.at_ns), one) for one in self._kept)
        ahead_ns = best.ahead_ns + slope * (now_ns - best.at_ns)
        return Estimate(ahead_ns, doubt_ns, slope, self._slope is not None, best.round_trip_ns)

    def _contradicts(self, new: Sample) -> bool:
        known = self.at(new.at_ns)
        return known is not None and abs(new.ahead_ns - known.ahead_ns) > new.doubt_ns + known.uncertainty_ns

    def _take(self, new: Sample) -> None:
        while self._kept and new.at_ns - self._kept[0].at_ns > KEPT_NS:
            self._kept.popleft()
        self._kept.append(new)
        if not self._slots or new.at_ns - self._slot_ns >= SLOT_NS:
            self._slope = self._observed_slope()
            self._slots.append(new)
            self._slot_ns = new.at_ns
        elif new.round_trip_ns < self._slots[-1].round_trip_ns:
            self._slots[-1] = new

    def _observed_slope(self) -> float | None:
        if len(self._slots) < FEWEST_SLOTS:
            return None
        limit_ns = median(one.round_trip_ns for one in self._slots)
        good = [one for one in self._slots if one.round_trip_ns <= limit_ns]
        jitter_ns = median(one.doubt_ns for one in good) - min(one.doubt_ns for one in good)
        if 2 * jitter_ns > KNOWN_PPM * PPM * (good[-1].at_ns - good[0].at_ns):
            return None
        slopes = [
            (later.ahead_ns - one.ahead_ns) / (later.at_ns - one.at_ns)
            for number, one in enumerate(good)
            for later in good[number + 1 :]
            if later.at_ns - one.at_ns >= SLOT_NS
        ]
        return median(slopes) if slopes else None


def _agree(old: Sample, new: Sample) -> bool:
    within_ns = old.doubt_ns + new.doubt_ns + UNKNOWN_PPM * PPM * abs(new.at_ns - old.at_ns)
    return abs(new.ahead_ns - old.ahead_ns) <= within_ns


# --- correction and trust -----------------------------------------------------------------------------

SLEW_PPM = 500.0
"""A clock is corrected by at most this rate, as NTP does: 0.5 ms per second."""
SETTLES_S = 10.0
"""A remaining difference shrinks with this time constant: exchanges differ by their networks' jitter."""


def correction_ns(difference_ns: float, slope: float, passed_ns: int) -> int:
    """What to add to this machine's offset for the time that has passed. `difference_ns` is the wanted offset minus
    the present one."""
    wanted = slope * passed_ns + difference_ns * passed_ns / (SETTLES_S * NS)
    most = SLEW_PPM * PPM * passed_ns
    return round(min(max(wanted, -most), most))


class Trust:
    """Whether this host's clock can be trusted, with hysteresis. Look regularly; no single look decides."""

    REFUSED_AFTER = 3
    ADMITTED_AFTER = 12
    ADMITTED_SHARE = 0.8
    """Of the limit: below it the clock is trusted again."""

    def __init__(self, limit_ns: float) -> None:
        self.limit_ns = limit_ns
        self._streak = 0
        self.refused = False

    def refuse(self) -> None:
        """Refuses at once, for a clock that was never compared."""
        self.refused = True
        self._streak = 0

    def look(self, bound_ns: float) -> None:
        """`bound_ns`: the most by which the clock may be wrong."""
        contrary = bound_ns < self.ADMITTED_SHARE * self.limit_ns if self.refused else bound_ns > self.limit_ns
        self._streak = self._streak + 1 if contrary else 0
        if self._streak >= (self.ADMITTED_AFTER if self.refused else self.REFUSED_AFTER):
            self.refused = not self.refused
            self._streak = 0
