"""The decisions of the guard of the Create's port: a pure state machine from received bytes and commands to bytes to
write.

The wheels may turn only while all of this holds: the service asked for it within the deadman time; the Create sends
frames; the Create is in the mode that the guard chose; no bumper, cliff sensor or wheel drop forbids it.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from services.base import oi

LinkState = Literal["closed", "silent", "waking", "up", "fallen"]
"""closed: no port is open. silent: no valid frames arrive. waking: the guard puts the Create into its mode. up: it
obeys. fallen: the Create left the mode by itself, and stays so until the operator recovers it."""

MS = 1_000_000
SAFE = oi.MODES.index("safe")
SILENT_NS = 180 * MS
"""After twelve missing frames the Create counts as silent."""
RESEND_NS = 40 * MS
"""Period at which an unchanged wheel command is repeated, since one may have been lost on the wire."""
HEEDED_NS = 75 * MS
"""Time after which a frame must confirm a command; otherwise the command was lost or garbled. The longest commands take
46 ms on the wire, and a frame comes every 15 ms."""
COUNTS_NS = 200 * MS
"""Period at which distance and angle are requested. At 5 Hz their units, 1 mm and 1 degree, are small compared with
what they count."""
COUNTS_LATE_NS = 60 * MS
WAKE_NS = 500 * MS
RIGHT_AGAIN_NS = 5000 * MS

SHORT = (
    oi.BUMPS, *oi.CLIFFS, oi.OVERCURRENTS, oi.BUTTONS, oi.CHARGING, oi.VOLTAGE, oi.CURRENT, oi.TEMPERATURE,
    oi.CHARGE, oi.CAPACITY, oi.CHARGERS, oi.MODE, oi.RIGHT_SPEED, oi.LEFT_SPEED,
)  # fmt: skip
LONG = (*SHORT, oi.DISTANCE, oi.ANGLE)
"""A frame with distance and angle resets both counters and loses what is less than a unit. So only one frame every
`COUNTS_NS` contains them: the list of packets is changed for just that long. A frame's checksum protects them."""


class WheelSpeeds(NamedTuple):
    left_mmps: int
    right_mmps: int
    why: str = ""
    """Why they do not turn as the service asked; '' when they do."""


STILL = WheelSpeeds(0, 0)


def reflex(wanted: WheelSpeeds, readings: oi.Readings) -> WheelSpeeds:
    """The part of the wanted speeds that the robot's sensors allow.

    With a bumper pressed or at a cliff the base must not drive forward, but it may turn on the spot and back away.
    """
    left, right, _ = wanted
    if readings[oi.BUMPS] & oi.WHEEL_DROPS:
        return WheelSpeeds(0, 0, "wheel drop")
    if readings[oi.OVERCURRENTS] & oi.WHEEL_OVERCURRENTS:
        return WheelSpeeds(0, 0, "overcurrent")
    cliff = any(readings[packet] for packet in oi.CLIFFS)
    bump = readings[oi.BUMPS] & (oi.BUMP_LEFT | oi.BUMP_RIGHT)
    if (cliff or bump) and left + right > 0:
        half = (left - right) // 2
        return WheelSpeeds(oi.harmless(half), oi.harmless(-half), "cliff" if cliff else "bump")
    return wanted


class GuardLogic:
    """Every `now_ns` is CLOCK_MONOTONIC. `mode` is safe or full."""

    def __init__(self, mode: str, deadman_ns: int) -> None:
        self.link: LinkState = "closed"
        self.readings: oi.Readings = {}
        """The newest frame."""
        self.wheels = STILL
        """The newest command to the Create."""
        self.damage = 0
        """Count of received bytes that were not part of a valid frame, and of commands that arrived garbled or not at
        all."""
        self.stops = 0
        """Count of emergency stops; the wheels stand until each of them has been reset."""
        self._reset_stops = 0
        self._mode = mode
        self._deadman_ns = deadman_ns
        self._parser = oi.StreamParser((SHORT, LONG))
        self._wanted = STILL
        self._until_ns = 0
        self._frame_ns = 0
        self._sent_ns = 0
        self._changed_ns = 0
        self._overran_ns = 0
        self._ended_ns: int | None = None
        self._halted_ns: int | None = None
        self._stop_sent = False
        self._counted_ns = 0
        self._counting_ns: int | None = None
        self._counts_lost = False
        self._righted_ns = -RIGHT_AGAIN_NS
        self._wake_ns = 0
        self._wake: list[tuple[int, bytes]] = []

    # --- inputs -------------------------------------------------------------------------------------

    def opened(self, now_ns: int) -> None:
        """The port was opened: put the Create into its mode."""
        self._parser.reset()
        self._start_waking(now_ns)

    def closed(self) -> None:
        """The port was lost."""
        self.link = "closed"
        self.readings = {}
        self._counts_lost = True

    def ask(self, left_mmps: int, right_mmps: int, until_ns: int, now_ns: int) -> None:
        """The service asks for wheel speeds until `until_ns`, and never for longer than the deadman time."""
        self._wanted = WheelSpeeds(oi.harmless(left_mmps), oi.harmless(right_mmps))
        self._until_ns = min(until_ns, now_ns + self._deadman_ns)

    def stop(self) -> None:
        """Emergency stop: the wheels stand until this stop has been reset."""
        self.stops += 1

    def reset(self, stops: int) -> None:
        """The operator has reset the first `stops` emergency stops."""
        self._reset_stops = min(max(stops, 0), self.stops)

    def recover(self, now_ns: int) -> None:
        """The operator lets a Create that left its mode go on."""
        if self.link == "fallen":
            self._start_waking(now_ns)

    def end(self, now_ns: int) -> None:
        """The service is gone: from now on the guard only stops the wheels."""
        self._ended_ns = now_ns

    def receive(self, data: bytes, now_ns: int) -> list[oi.Readings]:
        """Take bytes from the Create; returns the valid frames in them."""
        skipped = self._parser.skipped
        frames = self._parser.feed(data)
        if self._parser.skipped > skipped and self.link == "up":
            self.damage += self._parser.skipped - skipped
            self._counts_lost = self._counts_lost or self._counting_ns is not None
        for readings in frames:
            self.readings = readings
            self._frame_ns = now_ns
            good = oi.MODES[readings[oi.MODE]] == self._mode
            if self.link in ("waking", "silent"):
                if good and not self._wake:
                    self.link = "up"
            elif not good and self.link != "fallen":
                self._fell(now_ns)
        return frames

    def take_counts_lost(self) -> bool:
        """Whether a count of distance and angle may have been lost on the wire since the last call."""
        lost, self._counts_lost = self._counts_lost, False
        return lost

    @property
    def stands(self) -> bool:
        """Whether a frame since `end` confirms that the commanded speeds are zero, or, in a mode that ignores speeds,
        arrived long enough after the halt."""
        if self._ended_ns is None or self._frame_ns <= self._ended_ns:
            return False
        readings = self.readings
        if readings[oi.MODE] < SAFE:
            return self._halted_ns is not None and self._frame_ns > self._halted_ns + HEEDED_NS
        return (readings[oi.LEFT_SPEED], readings[oi.RIGHT_SPEED]) == (0, 0)

    # --- outputs ------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> bytes:
        """The bytes to write to the port now. Call it after each input, and every few milliseconds."""
        if self.link == "closed":
            return b""
        if self._ended_ns is not None:
            return self._stop(now_ns)
        if self.link in ("up", "fallen") and now_ns - self._frame_ns > SILENT_NS:
            self.link = "silent"
            self._counts_lost = True
            self._start_waking(now_ns)
        elif self.link in ("waking", "silent") and now_ns - self._wake_ns > WAKE_NS:
            if now_ns - self._frame_ns <= SILENT_NS:
                self.link = "fallen"
            else:
                self._start_waking(now_ns)
                self.link = "silent"
        return self._waking(now_ns) + self._counts(now_ns) + self._drive(now_ns)

    def allowed(self, now_ns: int) -> WheelSpeeds:
        """The speeds that are allowed now, and the reason for any limit."""
        if self.link != "up":
            return WheelSpeeds(0, 0, "mode" if self.link == "fallen" else "link")
        if self.stops > self._reset_stops:
            return WheelSpeeds(0, 0, "estop")
        if now_ns > self._until_ns:
            return WheelSpeeds(0, 0, "no command")
        return reflex(self._wanted, self.readings)

    def _drive(self, now_ns: int) -> bytes:
        wheels, before = self.allowed(now_ns), self.wheels
        self.wheels = wheels
        # Each frame repeats the commanded speeds, so a command that was garbled on its way is noticed and sent again.
        heeded = (self.readings.get(oi.LEFT_SPEED), self.readings.get(oi.RIGHT_SPEED)) == wheels[:2]
        stale = self._frame_ns > self._sent_ns and not heeded
        if wheels[:2] != before[:2]:
            self._changed_ns = now_ns
        elif stale and self.link == "up" and now_ns - self._changed_ns > HEEDED_NS:
            self.damage += 1
            if now_ns - self._overran_ns > HEEDED_NS:
                self._sent_ns = self._overran_ns = now_ns
                return oi.drive_direct(wheels.left_mmps, wheels.right_mmps) * oi.OVERRUN
        if wheels[:2] == before[:2] and now_ns - self._sent_ns < RESEND_NS and not stale:
            return b""
        self._sent_ns = now_ns
        return oi.drive_direct(wheels.left_mmps, wheels.right_mmps)

    def _stop(self, now_ns: int) -> bytes:
        """Stop the wheels: first by a drive command; by a halt when no frame confirms that. The drive command may be
        lost or garbled, be taken for the data of another command, or be ignored in the Create's mode."""
        assert self._ended_ns is not None
        if not self._stop_sent:
            self._stop_sent = True
            if self.readings.get(oi.MODE, SAFE) >= SAFE:
                return oi.drive_direct(0, 0)
        elif self.stands or now_ns < (self._ended_ns if self._halted_ns is None else self._halted_ns) + HEEDED_NS:
            return b""
        self._halted_ns = now_ns
        return oi.halt()

    def _counts(self, now_ns: int) -> bytes:
        if self.link != "up":
            self._counting_ns = None
            return b""
        if self._counting_ns is None:
            if now_ns - self._counted_ns < COUNTS_NS:
                return b""
            self._counting_ns = now_ns
            return oi.stream(LONG)
        if oi.DISTANCE in self.readings:
            self._counting_ns = None
            self._counted_ns = now_ns
            return oi.stream(SHORT)
        if now_ns - self._counting_ns > COUNTS_LATE_NS:
            self._counting_ns = now_ns
            self._counts_lost = True
            return oi.stream(LONG)
        return b""

    def _fell(self, now_ns: int) -> None:
        """Handle a Create that left its mode. When its own safety caused that, the operator must recover it. Otherwise
        a lost byte may have become a command, even a demo: the guard ends that at once, but not more than every 5 s."""
        if not self._has_cause() and now_ns - self._righted_ns > RIGHT_AGAIN_NS:
            self._righted_ns = now_ns
            self._start_waking(now_ns)
        else:
            self.link = "fallen"

    def _has_cause(self) -> bool:
        """Whether the sensors show a cause for leaving safe mode."""
        readings = self.readings
        return bool(readings[oi.BUMPS] & oi.WHEEL_DROPS or readings[oi.CHARGERS] or any(readings[p] for p in oi.CLIFFS))

    def _start_waking(self, now_ns: int) -> None:
        self.link = "waking"
        self._wake_ns = now_ns
        self._counting_ns = None
        # The halt comes first, in case that the Create still drives. A change of mode takes it up to 20 ms.
        self._wake = [
            (now_ns, oi.halt()),
            (now_ns + 100 * MS, oi.enter(self._mode)),
            (now_ns + 150 * MS, oi.drive_direct(0, 0) + oi.stream(SHORT)),
        ]

    def _waking(self, now_ns: int) -> bytes:
        data = b""
        while self._wake and self._wake[0][0] <= now_ns:
            data += self._wake.pop(0)[1]
        return data
