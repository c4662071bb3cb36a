"""The process that has the Kinect open: libfreenect's callbacks in, pairs of colour and depth out.

It is one of its own because of what it holds: a C library and USB. Where they hang, crash or (as the playback library
does) end their process, this one ends with them, the service says so and starts it again; reconnecting is no more
than that.

    python -m services.kinect.grabber --fd N --memory M

`--fd` is its end of a SOCK_SEQPACKET pair, `--memory` a file in memory that holds `BUFFERS` colour and as many depth
pictures. Up go messages, in JSON: {"open": true, ...}, then a pair each, {"colour": buffer, "depth": buffer,
"t": CLOCK_MONOTONIC in ns of the colour picture}; {"fault": sentence} is its last. Down come {"free": [colour, depth]},
{"tilt": degrees}, {"led": name}. It ends when the other end closes.
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
from typing import Any

from services.kinect import recording
from services.kinect.freenect import (
    COLOUR_BYTES,
    DEPTH_BYTES,
    LEDS,
    DeviceError,
    Kind,
    Kinect,
    MissingLibraryError,
    find,
    load,
)
from services.kinect.pairing import DeviceClock, Pairer, Picture

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
        self.counts: dict[Kind, int] = {"colour": 0, "depth": 0}
        self.dropped = 0
        self._channel = channel
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self._free: dict[Kind, list[int]] = {kind: list(range(BUFFERS)) for kind in self.counts}
        self._clocks = {kind: DeviceClock() for kind in self.counts}
        self._pairer = Pairer()

    def heard(self, kind: Kind, pixels: int, ticks: int) -> None:
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
        pair, free = self._pairer.add(kind, Picture(at_ns, buffer))
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

    def obey(self, kinect: Kinect) -> bool:
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

    def _do(self, asked: dict[str, Any], kinect: Kinect) -> None:
        if "free" in asked:
            self._take_back(*asked["free"])
        if "tilt" in asked:
            kinect.tilt(asked["tilt"])
        if "led" in asked:
            kinect.led(asked["led"])

    def _take_back(self, colour: int, depth: int) -> None:
        self._free["colour"].append(colour)
        self._free["depth"].append(depth)


def offset(kind: Kind, buffer: int) -> int:
    """Where a picture begins in the memory."""
    return buffer * COLOUR_BYTES if kind == "colour" else BUFFERS * COLOUR_BYTES + buffer * DEPTH_BYTES


def size(kind: Kind) -> int:
    return COLOUR_BYTES if kind == "colour" else DEPTH_BYTES


def grab(grabber: Grabber, options: argparse.Namespace) -> None:
    """Until the other end closes. Raises DeviceError and MissingLibraryError."""
    played = os.environ.get(RECORDING, "")
    if played:
        recording.check(played)
    kinect = Kinect(load(find(options.library, bool(played))), grabber.heard)
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


def _said(kinect: Kinect) -> str:
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
