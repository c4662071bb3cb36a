"""The process that has the Kinect open: receives libfreenect's callbacks, sends pairs of colour and depth images.

It is a separate process because it runs a C library on USB: when that hangs, crashes or ends the process (as the
playback library does), the service reports a fault and starts this process again.

    python -m services.kinect.grabber --fd N --memory M

`--fd` is its end of a SOCK_SEQPACKET pair, `--memory` a memory file with `BUFFERS` colour and as many depth images. It
sends messages in JSON: {"open": true, ...}, then {"colour": buffer, "depth": buffer, "t": CLOCK_MONOTONIC of the colour
image, ns} for each pair, and {"fault": sentence} before it ends. It receives {"free": [colour, depth]},
{"tilt": degrees} and {"led": name}. It ends when the other end closes.

The Kinect's cameras run freely at 30 Hz each and stamp their images by the device's clock, without jitter but also
without relation to other clocks. `DeviceClock` converts these stamps, and `Pairer` finds the pairs.
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
"""Largest time between the two images of a pair: in free-running streams of equal rate the nearest image is within half
a period; plus some jitter."""
DRIFT = 100e-6
"""Largest difference in rate between the device's clock and this machine's; quartz oscillators are within 50 ppm."""
RESTART_NS = NS // 5
"""An image that arrives this much later than expected shows that the device's clock restarted or stands still."""
WRAP = 1 << 32
WAITING = 2
"""Largest number of images of one kind that wait for their partners."""


class DeviceClock:
    """Converts the stamps of one stream to CLOCK_MONOTONIC, as if each image had arrived with the smallest delay
    seen."""

    def __init__(self) -> None:
        self._ticks: int | None = None
        self._device_ns = 0.0
        self._offset_ns = 0.0

    def at(self, ticks: int, arrival_ns: int) -> int:
        """The time at which an image would have arrived with the smallest delay, ns, by the clock of `arrival_ns`."""
        if self._ticks is None:
            self._offset_ns = arrival_ns - self._device_ns
        else:
            passed = (ticks - self._ticks + WRAP // 2) % WRAP - WRAP // 2
            passed_ns = passed * NS / TICKS_HZ
            self._device_ns += passed_ns
            self._offset_ns += abs(passed_ns) * DRIFT
        self._ticks = ticks
        seen_ns = arrival_ns - self._device_ns
        if seen_ns < self._offset_ns or seen_ns - self._offset_ns > RESTART_NS:
            self._offset_ns = seen_ns
        return round(self._device_ns + self._offset_ns)


class BufferedImage(NamedTuple):
    """An image in a buffer of the shared memory."""

    at_ns: int
    """CLOCK_MONOTONIC."""
    buffer: int


class ImagePair(NamedTuple):
    colour: BufferedImage
    depth: BufferedImage


class Pairer:
    """Finds pairs of images that were taken at about the same time."""

    def __init__(self) -> None:
        self._waiting: dict[ImageKind, list[BufferedImage]] = {"colour": [], "depth": []}

    def add(self, kind: ImageKind, image: BufferedImage) -> tuple[ImagePair | None, list[tuple[ImageKind, int]]]:
        """Add an image; returns the pair that it completes, and the buffers that are free now because their images will
        be in no pair, with their kinds."""
        other: ImageKind = "depth" if kind == "colour" else "colour"
        near = min(self._waiting[other], key=lambda waiting: abs(waiting.at_ns - image.at_ns), default=None)
        if near is None or abs(near.at_ns - image.at_ns) > TOLERANCE_NS:
            waiting = self._waiting[kind]
            waiting.append(image)
            return None, [(kind, waiting.pop(0).buffer)] if len(waiting) > WAITING else []
        self._waiting[other].remove(near)
        pair = ImagePair(image, near) if kind == "colour" else ImagePair(near, image)
        free: list[tuple[ImageKind, int]] = []
        for each, waiting in self._waiting.items():
            # Images older than this pair will have no partner.
            own_ns = (pair.colour if each == "colour" else pair.depth).at_ns
            free += [(each, one.buffer) for one in waiting if one.at_ns < own_ns]
            waiting[:] = [one for one in waiting if one.at_ns >= own_ns]
        return pair, free


BUFFERS = 6
"""Buffers of each kind: two hold images that wait for partners, two are being read, the others are filled next."""
MEMORY_BYTES = BUFFERS * (COLOUR_BYTES + DEPTH_BYTES)
WAIT_S = 0.05
FIRST_S, SILENT_S = 4.0, 1.0
"""Time limits for the first and for each further image: a Kinect that is unplugged may just become silent."""
FAULT_S = 0.5
"""Time limit for sending the last message."""
RECORDING = "FAKENECT_PATH"
"""Environment variable that names the playback library's recording."""


class Grabber:
    """Copies images into the shared memory, and sends their pairs."""

    def __init__(self, channel: socket.socket, memory: mmap.mmap) -> None:
        self.image_s = time.monotonic() + FIRST_S - SILENT_S
        self.counts: dict[ImageKind, int] = {"colour": 0, "depth": 0}
        self.dropped = 0
        self._channel = channel
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self._free: dict[ImageKind, list[int]] = {kind: list(range(BUFFERS)) for kind in self.counts}
        self._clocks = {kind: DeviceClock() for kind in self.counts}
        self._pairer = Pairer()

    def on_image(self, kind: ImageKind, pixels: int, ticks: int) -> None:
        """Take an image from the library: the address of its pixels and its stamp."""
        now_ns = time.monotonic_ns()
        self.image_s = now_ns / 1e9
        self.counts[kind] += 1
        at_ns = self._clocks[kind].at(ticks, now_ns)
        if not self._free[kind]:  # nobody reads
            self.dropped += 1
            return
        buffer = self._free[kind].pop()
        ctypes.memmove(self._address + offset(kind, buffer), pixels, size(kind))
        pair, free = self._pairer.add(kind, BufferedImage(at_ns, buffer))
        for free_kind, number in free:
            self._free[free_kind].append(number)
        if pair is not None and not self.send(colour=pair.colour.buffer, depth=pair.depth.buffer, t=pair.colour.at_ns):
            self._take_back(pair.colour.buffer, pair.depth.buffer)

    def send(self, **message: object) -> bool:
        """Send a message. False when the socket is full."""
        try:
            self._channel.send(json.dumps(message).encode())
        except BlockingIOError:
            return False
        return True

    def obey(self, kinect: FreenectDevice) -> bool:
        """Carry out the requests that wait. False when the other end is closed."""
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

    def _do(self, request: dict[str, Any], kinect: FreenectDevice) -> None:
        if "free" in request:
            self._take_back(*request["free"])
        if "tilt" in request:
            kinect.tilt(request["tilt"])
        if "led" in request:
            kinect.led(request["led"])

    def _take_back(self, colour: int, depth: int) -> None:
        self._free["colour"].append(colour)
        self._free["depth"].append(depth)


def offset(kind: ImageKind, buffer: int) -> int:
    """Offset of a buffer in the shared memory, bytes."""
    return buffer * COLOUR_BYTES if kind == "colour" else BUFFERS * COLOUR_BYTES + buffer * DEPTH_BYTES


def size(kind: ImageKind) -> int:
    return COLOUR_BYTES if kind == "colour" else DEPTH_BYTES


def grab(grabber: Grabber, options: argparse.Namespace) -> None:
    """Grab until the other end closes. Raises DeviceError or MissingLibraryError."""
    recording = os.environ.get(RECORDING, "")
    if recording:
        check_recording(recording)
    kinect = FreenectDevice(load(find(options.library, bool(recording))), grabber.on_image)
    try:
        kinect.tilt(options.tilt)
        kinect.led(options.led)
        tilt = kinect.read_tilt()
        grabber.send(open=True, motor=kinect.has_motor, tilt_deg=tilt.angle_deg if tilt else None)
        while grabber.obey(kinect):
            if kinect.process(WAIT_S) < 0:
                raise DeviceError(
                    "the recording has ended" if recording else f"the Kinect was unplugged{_log_suffix(kinect)}"
                )
            if time.monotonic() - grabber.image_s > SILENT_S:
                raise DeviceError(f"the Kinect sends no pictures: is its own 12 V supply on?{_log_suffix(kinect)}")
            if not all(grabber.counts.values()) and max(grabber.counts.values()) > 90:
                silent = min(grabber.counts, key=lambda kind: grabber.counts[kind])
                raise DeviceError(f"the Kinect sends no {silent} pictures{_log_suffix(kinect)}")
        kinect.led("off")
    finally:
        kinect.close()


def _log_suffix(kinect: FreenectDevice) -> str:
    return f" ({kinect.log})" if kinect.log else ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m services.kinect.grabber", description="Keep a Kinect open.")
    parser.add_argument("--fd", type=int, required=True, help="this process's end of a socket pair")
    parser.add_argument("--memory", type=int, required=True, help="the memory file for the images")
    parser.add_argument("--library", default="", help="path of a libfreenect; by default the system's")
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
        channel.settimeout(FAULT_S)
        with suppress(OSError):
            grabber.send(fault=str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
