"""Which colour picture belongs to which depth picture, and when they were taken. Pure.

The Kinect's two cameras run freely at 30 Hz each and stamp their pictures by the device's own clock. Those stamps have
no jitter but also no relation to anybody else's time; the time at which a picture arrives here has both.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import mmap
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from typing import Any, NamedTuple

from services.kinect.freenect import (
    COLOUR_BYTES,
    DEPTH_BYTES,
    LEDS,
    TICKS_HZ,
    DeviceError,
    FreenectDevice,
    ImageKind,
    MissingLibraryError,
    check_recording,
    find,
    load,
)

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


class BufferedImage(NamedTuple):
    """One picture in its buffer."""

    at_ns: int
    buffer: int


class ImagePair(NamedTuple):
    colour: BufferedImage
    depth: BufferedImage


class Pairer:
    """Told of every picture; gives pairs, and the buffers of pictures that will be in none."""

    def __init__(self) -> None:
        self._waiting: dict[ImageKind, list[BufferedImage]] = {"colour": [], "depth": []}

    def add(self, kind: ImageKind, picture: BufferedImage) -> tuple[ImagePair | None, list[tuple[ImageKind, int]]]:
        """The pair that this picture completes, and the buffers that are free now, with their kinds."""
        other: ImageKind = "depth" if kind == "colour" else "colour"
        near = min(self._waiting[other], key=lambda waiting: abs(waiting.at_ns - picture.at_ns), default=None)
        if near is None or abs(near.at_ns - picture.at_ns) > TOLERANCE_NS:
            waiting = self._waiting[kind]
            waiting.append(picture)
            return None, [(kind, waiting.pop(0).buffer)] if len(waiting) > WAITING else []
        self._waiting[other].remove(near)
        pair = ImagePair(picture, near) if kind == "colour" else ImagePair(near, picture)
        free: list[tuple[ImageKind, int]] = []
        for each, waiting in self._waiting.items():
            # What is older than a pair has missed its partner.
            own_ns = (pair.colour if each == "colour" else pair.depth).at_ns
            free += [(each, one.buffer) for one in waiting if one.at_ns < own_ns]
            waiting[:] = [one for one in waiting if one.at_ns >= own_ns]
        return pair, free


BUFFERS = 6
"""Of each kind: two wait for their partners, two are being read, the others are there to be filled."""
MEMORY_BYTES = BUFFERS * (COLOUR_BYTES + DEPTH_BYTES)
WAIT_S = 0.05
FIRST_S, SILENT_S = 4.0, 1.0
"""A Kinect whose cable is pulled may just say nothing more. Its first picture takes a while."""
TOLD_S = 0.5
RECORDING = "FAKENECT_PATH"
"""Where the playback library looks for its recording."""


class Grabber:
    def __init__(self, channel: socket.socket, memory: mmap.mmap) -> None:
        self.heard_s = time.monotonic() + FIRST_S - SILENT_S
        self.counts: dict[ImageKind, int] = {"colour": 0, "depth": 0}
        self.dropped = 0
        self._channel = channel
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self._free: dict[ImageKind, list[int]] = {kind: list(range(BUFFERS)) for kind in self.counts}
        self._clocks = {kind: DeviceClock() for kind in self.counts}
        self._pairer = Pairer()

    def heard(self, kind: ImageKind, pixels: int, ticks: int) -> None:
        """A picture, as the library calls back with it."""
        now_ns = time.monotonic_ns()
        self.heard_s = now_ns / 1e9
        self.counts[kind] += 1
        at_ns = self._clocks[kind].at(ticks, now_ns)
        if not self._free[kind]:  # nobody reads
            self.dropped += 1
            return
        buffer = self._free[kind].pop()
        ctypes.memmove(self._address + offset(kind, buffer), pixels, size(kind))
        pair, free = self._pairer.add(kind, BufferedImage(at_ns, buffer))
        for of_kind, number in free:
            self._free[of_kind].append(number)
        if pair is not None and not self.say(colour=pair.colour.buffer, depth=pair.depth.buffer, t=pair.colour.at_ns):
            self._take_back(pair.colour.buffer, pair.depth.buffer)

    def say(self, **message: object) -> bool:
        """False when it could not be said now."""
        try:
            self._channel.send(json.dumps(message).encode())
        except BlockingIOError:
            return False
        return True

    def obey(self, kinect: FreenectDevice) -> bool:
        """Do what was asked meanwhile. False when the other end is closed."""
        while True:
            try:
                message = self._channel.recv(4096)
            except BlockingIOError:
                return True
            except ConnectionError:
                return False
            if not message:
                return False
            self._do(json.loads(message), kinect)

    def _do(self, asked: dict[str, Any], kinect: FreenectDevice) -> None:
        if "free" in asked:
            self._take_back(*asked["free"])
        if "tilt" in asked:
            kinect.tilt(asked["tilt"])
        if "led" in asked:
            kinect.led(asked["led"])

    def _take_back(self, colour: int, depth: int) -> None:
        self._free["colour"].append(colour)
        self._free["depth"].append(depth)


def offset(kind: ImageKind, buffer: int) -> int:
    """Where a picture begins in the memory."""
    return buffer * COLOUR_BYTES if kind == "colour" else BUFFERS * COLOUR_BYTES + buffer * DEPTH_BYTES


def size(kind: ImageKind) -> int:
    return COLOUR_BYTES if kind == "colour" else DEPTH_BYTES


def grab(grabber: Grabber, options: argparse.Namespace) -> None:
    """Until the other end closes. Raises DeviceError and MissingLibraryError."""
    played = os.environ.get(RECORDING, "")
    if played:
        check_recording(played)
    kinect = FreenectDevice(load(find(options.library, bool(played))), grabber.heard)
    try:
        kinect.tilt(options.tilt)
        kinect.led(options.led)
        felt = kinect.feel()
        grabber.say(open=True, motor=kinect.has_motor, tilt_deg=felt.angle_deg if felt else None)
        while grabber.obey(kinect):
            if kinect.process(WAIT_S) < 0:
                raise DeviceError("the recording has ended" if played else f"the Kinect was unplugged{_said(kinect)}")
            if time.monotonic() - grabber.heard_s > SILENT_S:
                raise DeviceError(f"the Kinect sends no pictures: is its own 12 V supply on?{_said(kinect)}")
            if not all(grabber.counts.values()) and max(grabber.counts.values()) > 90:
                silent = min(grabber.counts, key=lambda kind: grabber.counts[kind])
                raise DeviceError(f"the Kinect sends no {silent} pictures{_said(kinect)}")
        kinect.led("off")
    finally:
        kinect.close()


def _said(kinect: FreenectDevice) -> str:
    return f" ({kinect.log})" if kinect.log else ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m services.kinect.grabber", description="Have a Kinect open.")
    parser.add_argument("--fd", type=int, required=True, help="this process's end of a socket pair")
    parser.add_argument("--memory", type=int, required=True, help="the file in memory that takes the pictures")
    parser.add_argument("--library", default="", help="instead of the system's libfreenect")
    parser.add_argument("--tilt", type=float, default=0.0, metavar="DEG")
    parser.add_argument("--led", choices=tuple(LEDS), default="green")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the service, which closes the socket
    channel = socket.socket(fileno=options.fd)
    channel.setblocking(False)
    memory = mmap.mmap(options.memory, MEMORY_BYTES)
    grabber = Grabber(channel, memory)
    try:
        grab(grabber, options)
    except (DeviceError, MissingLibraryError) as error:
        channel.setblocking(True)
        channel.settimeout(TOLD_S)
        with suppress(OSError):
            grabber.say(fault=str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
