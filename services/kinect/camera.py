"""The Kinect through libfreenect: starts the process that has it open, takes its pairs, starts it again if it ends."""

from __future__ import annotations

import asyncio
import json
import logging
import mmap
import os
import socket
import subprocess
import sys
import time
from collections.abc import AsyncGenerator
from contextlib import suppress
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from cocoro.arrays import ImageArray
from cocoro.clock import NS, Clock
from cocoro.errors import ConfigError
from services.kinect import freenect, grabber
from services.kinect.config import KinectConfig
from services.kinect.device import Shot, Tell
from services.kinect.freenect import HEIGHT, LED, WIDTH, Kind

log = logging.getLogger("cocoro.kinect")

AGAIN_S = 1.0
"""Between two attempts to open the device."""
FIRST_S, HANGS_S = 6.0, 2.0
"""A process that neither sends pictures (the first takes a while) nor ends within this time is killed: longer than it
waits itself."""
END_S = 1.0
SAID_BYTES = 4096
_PACKAGE = str(Path(__file__).parents[2])


class FreenectCamera:
    """Needs a running event loop. `tell(fault)` is called in it, whenever what is wrong has changed."""

    def __init__(self, config: KinectConfig, clock: Clock, tell: Tell) -> None:
        try:
            freenect.load(freenect.find(config.library, bool(config.recording)))
        except freenect.MissingLibraryError as error:
            raise ConfigError(f"kinect: {error}") from error
        self.starts = 0
        self.motor = False
        self._config = config
        self._clock = clock
        self._tell = tell
        self._fault = "the Kinect is being opened"
        self._led: LED = "green"
        self._tilt_deg = config.tilt_deg
        self._loop = asyncio.get_running_loop()
        memory = os.memfd_create("kinect")
        os.ftruncate(memory, grabber.MEMORY_BYTES)
        self._memory_fd = memory
        self._memory = mmap.mmap(memory, grabber.MEMORY_BYTES, prot=mmap.PROT_READ)
        self._channel: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._newest: dict[str, int] | None = None
        self._came = asyncio.Event()
        self._heard_s = 0.0
        self._said = b""
        self._again = self._loop.call_soon(self._start)
        tell(self._fault)

    async def shots(self) -> AsyncGenerator[Shot, None]:
        while True:
            limit_s = FIRST_S if self._fault else HANGS_S
            try:
                async with asyncio.timeout(limit_s):
                    await self._came.wait()
            except TimeoutError:
                if self._process is not None and time.monotonic() - self._heard_s > limit_s:
                    self._lost("the Kinect's library hangs")
                continue
            self._came.clear()
            if self._newest is not None:
                pair, self._newest = self._newest, None
                yield self._shot(pair)

    def tilt(self, angle_rad: float) -> None:
        self._tilt_deg = degrees(angle_rad)
        self._send(tilt=self._tilt_deg)

    def led(self, led: LED) -> None:
        self._led = led
        self._send(led=led)

    def close(self) -> None:
        self._again.cancel()
        process = self._let_go()
        os.close(self._memory_fd)
        if process is not None:
            _end(process)

    # --- pictures -----------------------------------------------------------------------------------

    def _shot(self, pair: dict[str, int]) -> Shot:
        """A copy of a pair, whose buffers are free then."""
        colour = self._view("colour", pair["colour"]).reshape(HEIGHT, WIDTH, 3).copy()
        depth = self._view("depth", pair["depth"]).view("<u2").reshape(HEIGHT, WIDTH).astype(np.uint16)
        self._send(free=(pair["colour"], pair["depth"]))
        age_ns = time.monotonic_ns() - pair["t"] + round(self._config.latency_s * NS)
        return Shot(self._clock.now_ns() - age_ns, colour, depth)

    def _view(self, kind: Kind, buffer: int) -> ImageArray:
        return np.frombuffer(self._memory, np.uint8, grabber.size(kind), grabber.offset(kind, buffer))

    def _take(self, message: dict[str, Any]) -> None:
        if "fault" in message:
            self._lost(message["fault"])
        elif "open" in message:
            self.motor = message["motor"]
        else:
            if self._newest is not None:  # nobody took it in time
                self._send(free=(self._newest["colour"], self._newest["depth"]))
            self._newest = message
            self._came.set()
            self._say("")

    # --- its process --------------------------------------------------------------------------------

    def _start(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        environment = os.environ | {"PYTHONPATH": _PACKAGE}
        if self._config.recording:
            environment[grabber.RECORDING] = self._config.recording
        # No site packages: it needs none, and is there quickly.
        command = [
            sys.executable, "-S", "-P", "-m", "services.kinect.grabber", "--fd", str(theirs.fileno()),
            "--memory", str(self._memory_fd), "--library", self._config.library,
            "--tilt", str(self._tilt_deg), "--led", self._led,
        ]  # fmt: skip
        with theirs:
            process = subprocess.Popen(
                command, env=environment, pass_fds=(theirs.fileno(), self._memory_fd), stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )  # fmt: skip
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        self._process, self._channel, self._said = process, ours, b""
        self._newest = None
        self._heard_s = time.monotonic()
        self.starts += 1
        self._loop.add_reader(ours, self._read, ours)
        self._loop.add_reader(process.stdout, self._listen, process)

    def _read(self, channel: socket.socket) -> None:
        while channel is self._channel:
            try:
                message = channel.recv(4096)
            except BlockingIOError:
                return
            except ConnectionError:
                message = b""
            if not message:
                self._lost(self._last_words())
                return
            self._heard_s = time.monotonic()
            self._take(json.loads(message))

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        """What the libraries print: their last words are told when they end their process."""
        assert process.stdout is not None
        with suppress(BlockingIOError):
            heard = os.read(process.stdout.fileno(), SAID_BYTES)
            self._said = (self._said + heard)[-SAID_BYTES:]
            if not heard:
                self._loop.remove_reader(process.stdout)

    def _last_words(self) -> str:
        if self._process is not None:
            self._listen(self._process)
        lines = self._said.decode(errors="replace").split("\n")
        words = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"the Kinect's library ended its process{f': {words}' if words else ''}"

    def _lost(self, why: str) -> None:
        """Say so, and try again."""
        self._say(why)
        process = self._let_go()
        if process is not None:
            self._loop.run_in_executor(None, _end, process)
            self._again = self._loop.call_later(AGAIN_S, self._start)

    def _say(self, fault: str) -> None:
        if fault != self._fault:
            self._fault = fault
            self._tell(fault)

    def _let_go(self) -> subprocess.Popen[bytes] | None:
        """What came last is still there to be taken."""
        channel, self._channel = self._channel, None
        process, self._process = self._process, None
        if channel is not None:
            self._loop.remove_reader(channel)
            channel.close()
        if process is not None and process.stdout is not None:
            self._loop.remove_reader(process.stdout)
        return process

    def _send(self, **message: object) -> None:
        if self._channel is not None:
            with suppress(BlockingIOError, ConnectionError):
                self._channel.send(json.dumps(message).encode())


def _end(process: subprocess.Popen[bytes]) -> None:
    """It ends by itself when its channel is closed, unless it hangs."""
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
