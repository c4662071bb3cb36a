"""The Kinect's driver: runs `services.kinect.grabber`, which has the device open, and starts it again when it ends."""

from __future__ import annotations

import asyncio
import json
import logging
import mmap
import os
import subprocess
import time
from collections.abc import AsyncGenerator, Mapping
from contextlib import suppress
from math import degrees
from typing import Any

import numpy as np

from cocoro.arrays import ImageArray
from cocoro.child import ChildProcess, wait_or_kill
from cocoro.clock import NS, Clock
from cocoro.errors import ConfigError
from services.kinect import freenect, grabber
from services.kinect.device import DepthCamera, DriverFactory, KinectConfig, OnFault, RawFrame
from services.kinect.freenect import HEIGHT, LED, WIDTH, ImageKind
from services.kinect.uvc import UvcCamera

log = logging.getLogger("cocoro.kinect")

AGAIN_S = 1.0
"""Time between two attempts to open the device."""
FIRST_S, HANGS_S = 6.0, 2.0
"""A grabber that sends no frame for this long (the first one takes longer) and does not end either hangs, and is
killed. Both are longer than the grabber's own limits."""
END_S = 1.0
OUTPUT_BYTES = 4096


class FreenectCamera:
    """The Kinect v1 through libfreenect. Calls `on_fault(fault)` in the running event loop whenever the fault
    changes."""

    def __init__(self, config: KinectConfig, clock: Clock, on_fault: OnFault) -> None:
        try:
            freenect.load(freenect.find(config.library, bool(config.recording)))
        except freenect.MissingLibraryError as error:
            raise ConfigError(f"kinect: {error}") from error
        self.starts = 0
        self.motor = False
        self._config = config
        self._clock = clock
        self._on_fault = on_fault
        self._fault = "the Kinect is being opened"
        self._led: LED = "green"
        self._tilt_deg = config.tilt_deg
        self._loop = asyncio.get_running_loop()
        memory = os.memfd_create("kinect")
        os.ftruncate(memory, grabber.MEMORY_BYTES)
        self._memory_fd = memory
        self._memory = mmap.mmap(memory, grabber.MEMORY_BYTES, prot=mmap.PROT_READ)
        self._grabber: ChildProcess | None = None
        self._newest: dict[str, int] | None = None
        self._came = asyncio.Event()
        self._received_s = 0.0
        self._output = b""
        self._again = self._loop.call_soon(self._start)
        on_fault(self._fault)

    async def frames(self) -> AsyncGenerator[RawFrame, None]:
        while True:
            limit_s = FIRST_S if self._fault else HANGS_S
            try:
                async with asyncio.timeout(limit_s):
                    await self._came.wait()
            except TimeoutError:
                if self._grabber is not None and time.monotonic() - self._received_s > limit_s:
                    self._restart("the Kinect's library hangs")
                continue
            self._came.clear()
            if self._newest is not None:
                pair, self._newest = self._newest, None
                yield self._frame(pair)

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
            wait_or_kill(process, END_S)

    # --- frames -------------------------------------------------------------------------------------

    def _frame(self, pair: dict[str, int]) -> RawFrame:
        """Copy a pair out of the shared memory and give its buffers back."""
        colour = self._view("colour", pair["colour"]).reshape(HEIGHT, WIDTH, 3).copy()
        depth = self._view("depth", pair["depth"]).view("<u2").reshape(HEIGHT, WIDTH).astype(np.uint16)
        self._send(free=(pair["colour"], pair["depth"]))
        age_ns = time.monotonic_ns() - pair["t"] + round(self._config.least_age_s * NS)
        return RawFrame(self._clock.now_ns() - age_ns, colour, depth)

    def _view(self, kind: ImageKind, buffer: int) -> ImageArray:
        return np.frombuffer(self._memory, np.uint8, grabber.size(kind), grabber.offset(kind, buffer))

    def _receive(self, data: bytes) -> None:
        self._received_s = time.monotonic()
        message: dict[str, Any] = json.loads(data)
        if "fault" in message:
            self._restart(message["fault"])
        elif "open" in message:
            self.motor = message["motor"]
        else:
            if self._newest is not None:  # nobody took it in time
                self._send(free=(self._newest["colour"], self._newest["depth"]))
            self._newest = message
            self._came.set()
            self._report("")

    # --- the grabber's process ----------------------------------------------------------------------

    def _start(self) -> None:
        # Without site packages, of which it needs none, it starts within milliseconds.
        child = ChildProcess(
            "services.kinect.grabber", "--memory", str(self._memory_fd), "--library", self._config.library,
            "--tilt", str(self._tilt_deg), "--led", self._led,
            environment={grabber.RECORDING: self._config.recording} if self._config.recording else None,
            site_packages=False, pass_fds=(self._memory_fd,), stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert child.process.stdout is not None
        os.set_blocking(child.process.stdout.fileno(), False)
        self._grabber, self._output = child, b""
        self._newest = None
        self._received_s = time.monotonic()
        self.starts += 1
        child.watch(self._receive, lambda: self._restart(self._last_words()))
        self._loop.add_reader(child.process.stdout, self._read_output, child.process)

    def _read_output(self, process: subprocess.Popen[bytes]) -> None:
        """Keep the end of what the libraries print: it says why, when they end their process."""
        assert process.stdout is not None
        with suppress(BlockingIOError):
            output = os.read(process.stdout.fileno(), OUTPUT_BYTES)
            self._output = (self._output + output)[-OUTPUT_BYTES:]
            if not output:
                self._loop.remove_reader(process.stdout)

    def _last_words(self) -> str:
        if self._grabber is not None:
            self._read_output(self._grabber.process)
        lines = self._output.decode(errors="replace").split("\n")
        words = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"the Kinect's library ended its process{f': {words}' if words else ''}"

    def _restart(self, why: str) -> None:
        """Report the fault, end the grabber, and start another one in a while."""
        self._report(why)
        process = self._let_go()
        if process is not None:
            self._loop.run_in_executor(None, wait_or_kill, process, END_S)
            self._again = self._loop.call_later(AGAIN_S, self._start)

    def _report(self, fault: str) -> None:
        if fault != self._fault:
            self._fault = fault
            self._on_fault(fault)

    def _let_go(self) -> subprocess.Popen[bytes] | None:
        """Ask the grabber to end. The newest pair stays valid in the shared memory."""
        child, self._grabber = self._grabber, None
        if child is None:
            return None
        child.close()
        if child.process.stdout is not None:
            self._loop.remove_reader(child.process.stdout)
        return child.process

    def _send(self, **message: object) -> None:
        if self._grabber is not None:
            self._grabber.send(json.dumps(message).encode())


DRIVERS: Mapping[str, DriverFactory] = {"freenect": FreenectCamera, "uvc": UvcCamera}
"""Drivers by the name that `device` in the service's settings chooses."""


def open_device(config: KinectConfig, clock: Clock, on_fault: OnFault) -> DepthCamera:
    """Open the configured device. Raises ConfigError when there is no such driver, or its library is missing."""
    if config.device not in DRIVERS:
        raise ConfigError(f"kinect: there is no driver {config.device!r} (known: {', '.join(DRIVERS)})")
    return DRIVERS[config.device](config, clock, on_fault)
