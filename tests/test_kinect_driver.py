"""The Kinect's driver without a Kinect: pairing by time, and a library that behaves like a device."""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import json
import mmap
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from cocoro.clock import RealClock
from cocoro.errors import ConfigError
from services.kinect import grabber as grabbing
from services.kinect.camera import FreenectCamera
from services.kinect.device import KinectConfig
from services.kinect.freenect import (
    COLOUR_BYTES,
    DEPTH_BYTES,
    DeviceError,
    FrameMode,
    FreenectDevice,
    MissingLibraryError,
    check_recording,
    load,
)
from services.kinect.grabber import NS, PERIOD_NS, BufferedImage, DeviceClock, Grabber, Pairer, grab

MS = 1_000_000
TICKS_A_MS = 60_000


# --- stamps -----------------------------------------------------------------------------------------


def test_stamps_have_the_devices_evenness_and_our_time() -> None:
    clock, late_ms = DeviceClock(), [9, 3, 0, 14, 2, 30, 1]
    stamps = [clock.at((7 + 33 * n) * TICKS_A_MS, (1000 + 33 * n + late) * MS) for n, late in enumerate(late_ms)]
    # From the image with the smallest delay on, the times have that delay, whatever the later delays are.
    assert stamps[2:] == pytest.approx([(1000 + 33 * n) * MS for n in range(2, 7)], abs=0.1 * MS)


def test_the_devices_clock_wraps_around_every_71_seconds() -> None:
    clock, ticks = DeviceClock(), (1 << 32) - 10 * TICKS_A_MS
    before = clock.at(ticks, 5 * NS)
    after = clock.at((ticks + 33 * TICKS_A_MS) % (1 << 32), 5 * NS + 33 * MS)
    assert after - before == pytest.approx(33 * MS, abs=0.1 * MS)


def test_a_clock_that_begins_anew_or_stands_is_not_followed() -> None:
    clock = DeviceClock()
    clock.at(3600 * 1000 * TICKS_A_MS % (1 << 32), 10 * NS)
    assert clock.at(0, 11 * NS) == pytest.approx(11 * NS, abs=MS)
    for second in range(12, 20):
        assert clock.at(0, second * NS) == pytest.approx(second * NS, abs=MS)


# --- pairs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("behind_ms", [-16, -8, 0, 5, 16])
def test_each_colour_picture_goes_with_the_nearest_depth_picture(behind_ms: int) -> None:
    pairer = Pairer()
    pictures = [("colour", n * PERIOD_NS, n) for n in range(20)]
    pictures += [("depth", n * PERIOD_NS + behind_ms * MS, n) for n in range(20)]
    pairs = []
    for kind, at_ns, buffer in sorted(pictures, key=lambda picture: picture[1]):
        pair, _ = pairer.add(kind, BufferedImage(at_ns, buffer))  # type: ignore[arg-type]
        if pair is not None:
            pairs.append((pair.colour.buffer, pair.depth.buffer))
    assert pairs == [(n, n) for n in range(20)]


def test_a_picture_whose_partner_was_lost_is_given_up_and_its_buffer_with_it() -> None:
    pairer = Pairer()
    assert pairer.add("colour", BufferedImage(0, 1)) == (None, [])
    assert pairer.add("colour", BufferedImage(PERIOD_NS, 2)) == (None, [])
    pair, free = pairer.add("depth", BufferedImage(PERIOD_NS, 3))
    assert pair is not None
    assert (pair.colour.buffer, pair.depth.buffer) == (2, 3)
    assert free == [("colour", 1)]


def test_of_a_stream_without_the_other_no_more_than_two_pictures_are_kept() -> None:
    pairer, freed = Pairer(), []
    for n in range(5):
        freed += pairer.add("depth", BufferedImage(n * PERIOD_NS, n))[1]
    assert freed == [("depth", 0), ("depth", 1), ("depth", 2)]


# --- the device -------------------------------------------------------------------------------------


class FakeLibrary:
    """libfreenect with a device that the test defines."""

    def __init__(self) -> None:
        self.devices = 1
        self.opens: Callable[[int], int] = lambda parts: 0
        self.calls: list[tuple[str, float]] = []
        self.process: Callable[[], int] = lambda: 0
        self._parts = 0
        self.colour: Any = None
        self.depth: Any = None

    def freenect_init(self, context: Any, usb: None) -> int:
        context._obj.value = 1
        return 0

    def freenect_shutdown(self, context: Any) -> int:
        self.calls.append(("shutdown", 0))
        return 0

    def freenect_set_log_level(self, context: Any, level: int) -> None: ...

    def freenect_set_log_callback(self, context: Any, callback: Any) -> None:
        self.log = callback

    def freenect_num_devices(self, context: Any) -> int:
        return self.devices

    def freenect_select_subdevices(self, context: Any, parts: int) -> None:
        self._parts = parts

    def freenect_open_device(self, context: Any, device: Any, number: int) -> int:
        device._obj.value = 2
        return self.opens(self._parts)

    def freenect_find_video_mode(self, resolution: int, kind: int) -> FrameMode:
        return FrameMode(bytes=COLOUR_BYTES)

    def freenect_find_depth_mode(self, resolution: int, kind: int) -> FrameMode:
        return FrameMode(bytes=DEPTH_BYTES)

    def freenect_set_video_callback(self, device: Any, callback: Any) -> None:
        self.colour = callback

    def freenect_set_depth_callback(self, device: Any, callback: Any) -> None:
        self.depth = callback

    def freenect_set_tilt_degs(self, device: Any, degrees: float) -> int:
        self.calls.append(("tilt", degrees))
        return 0

    def freenect_set_led(self, device: Any, led: int) -> int:
        self.calls.append(("led", led))
        return 0

    def freenect_update_tilt_state(self, device: Any) -> int:
        return -1

    def freenect_process_events_timeout(self, context: Any, wait: Any) -> int:
        return self.process()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("freenect_"):
            return lambda *_: 0
        raise AttributeError(name)


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, Grabber]]:
    """The service's end of the channel, and the grabber with the other end."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    ours.settimeout(10.0)
    memory = mmap.mmap(-1, grabbing.MEMORY_BYTES)
    with ours, theirs:
        yield ours, Grabber(theirs, memory)


def run(monkeypatch: pytest.MonkeyPatch, grabber: Grabber, library: FakeLibrary, tilt: float = 0.0) -> None:
    monkeypatch.setattr(grabbing, "load", lambda _: library)
    monkeypatch.delenv(grabbing.RECORDING, raising=False)
    grab(grabber, argparse.Namespace(library="", tilt=tilt, led="green"))


def test_pairs_come_with_tilt_and_light_set_and_the_light_goes_out_at_the_end(
    monkeypatch: pytest.MonkeyPatch, ends: tuple[socket.socket, Grabber]
) -> None:
    ours, grabber = ends
    library = FakeLibrary()
    told: list[Any] = []
    colour, depth = (ctypes.c_char * COLOUR_BYTES)(), (ctypes.c_char * DEPTH_BYTES)()

    def process() -> int:
        number = len(told)
        colour[0], depth[0] = bytes([number]), bytes([number + 100])
        library.depth(None, ctypes.addressof(depth), 1000 + number * 2_000_000)
        library.colour(None, ctypes.addressof(colour), 7000 + number * 2_000_000)
        told.append(json.loads(ours.recv(4096)))
        if "colour" in told[-1]:
            ours.send(json.dumps({"free": [told[-1]["colour"], told[-1]["depth"]]}).encode())
        if number == 20:
            ours.send(json.dumps({"tilt": 5.0, "led": "red"}).encode())
        elif number == 21:
            ours.close()
        return 0

    library.process = process
    run(monkeypatch, grabber, library, tilt=-3.0)
    assert told[0] == {"open": True, "motor": True, "tilt_deg": None}
    assert len([pair for pair in told if "t" in pair]) == 21  # many more than there are buffers
    assert grabber.dropped == 0
    assert library.calls == [("tilt", -3.0), ("led", 1), ("tilt", 5.0), ("led", 2), ("led", 0), ("shutdown", 0)]


def test_what_nobody_reads_is_dropped_and_the_next_is_read_again(ends: tuple[socket.socket, Grabber]) -> None:
    ours, grabber = ends
    colour, depth = (ctypes.c_char * COLOUR_BYTES)(), (ctypes.c_char * DEPTH_BYTES)()

    def picture(number: int) -> None:
        grabber.on_image("colour", ctypes.addressof(colour), number * 2_000_000)
        grabber.on_image("depth", ctypes.addressof(depth), number * 2_000_000)

    for number in range(20):
        picture(number)
    assert grabber.dropped > 0
    pairs = []
    ours.setblocking(False)
    while True:
        try:
            pairs.append(json.loads(ours.recv(4096)))
        except BlockingIOError:
            break
    assert len(pairs) == grabbing.BUFFERS
    ours.send(json.dumps({"free": [pairs[0]["colour"], pairs[0]["depth"]]}).encode())
    assert grabber.obey(FreenectDevice(FakeLibrary(), lambda *_: None))  # type: ignore[arg-type]
    picture(20)
    again = json.loads(ours.recv(4096))
    assert (again["colour"], again["depth"]) == (pairs[0]["colour"], pairs[0]["depth"])


def test_a_kinect_whose_motor_cannot_be_opened_gives_pictures_all_the_same(
    monkeypatch: pytest.MonkeyPatch, ends: tuple[socket.socket, Grabber]
) -> None:
    ours, grabber = ends
    library = FakeLibrary()
    library.opens = lambda parts: 0 if parts == 2 else -1

    def process() -> int:
        ours.close()
        return 0

    library.process = process
    run(monkeypatch, grabber, library, tilt=5.0)
    assert library.calls == [("shutdown", 0)]  # nothing was asked of the motor, which has the light


def _pulled(library: FakeLibrary, grabber: Grabber) -> None:
    library.process = lambda: library.log(None, 1, b"USB device disappeared\n") or -4


def _absent(library: FakeLibrary, grabber: Grabber) -> None:
    library.devices = 0


def _taken(library: FakeLibrary, grabber: Grabber) -> None:
    library.opens = lambda parts: -1


def _mute(library: FakeLibrary, grabber: Grabber) -> None:
    grabber.image_s -= 60.0


def _blind(library: FakeLibrary, grabber: Grabber) -> None:
    grabber.counts["colour"] = 91


@pytest.mark.parametrize(
    ("happens", "told"),
    [
        (_pulled, r"unplugged \(USB device disappeared\)"),
        (_absent, "no Kinect is found: is it plugged in"),
        (_taken, "cannot be opened: does another program use it, are you in the group plugdev"),
        (_mute, "sends no pictures: is its own 12 V supply on"),
        (_blind, "sends no depth pictures"),
    ],
)
def test_what_keeps_pictures_from_coming_is_said(
    happens: Callable[[FakeLibrary, Grabber], None],
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    ends: tuple[socket.socket, Grabber],
) -> None:
    library = FakeLibrary()
    happens(library, ends[1])
    with pytest.raises(DeviceError, match=told):
        run(monkeypatch, ends[1], library)
    assert library.calls[-1] == ("shutdown", 0)


# --- the library ------------------------------------------------------------------------------------


def test_a_library_that_is_not_there_or_is_another_is_said_with_the_package_to_install(tmp_path: Path) -> None:
    with pytest.raises(MissingLibraryError, match=r"cannot be loaded .*sudo apt install libfreenect0\.5"):
        load(str(tmp_path / "libfreenect.so"))
    with pytest.raises(MissingLibraryError, match=r"libc\.so\.6 is no libfreenect 0\.5"):
        load("libc.so.6")

    async def open_it() -> None:
        FreenectCamera(KinectConfig(library="/nowhere/libfreenect.so.0.5"), RealClock(), print)

    with pytest.raises(ConfigError, match=r"kinect: libfreenect .*sudo apt install libfreenect0\.5"):
        asyncio.run(open_it())


@pytest.mark.process
def test_a_process_that_ends_by_itself_is_told_and_started_again(tmp_path: Path) -> None:
    """A library that ends its process, as the playback library does; here because the folder is not a recording."""

    async def scenario() -> tuple[list[str], int]:
        faults: list[str] = []
        twice = asyncio.Event()
        config = KinectConfig(library="libc.so.6", recording=str(tmp_path))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("services.kinect.camera.freenect.load", lambda _: None)
            patch.setattr("services.kinect.camera.AGAIN_S", 0.01)
            camera = FreenectCamera(config, RealClock(), faults.append)
            starts = camera._start

            def start() -> None:
                starts()
                if camera.starts > 1:
                    twice.set()

            patch.setattr(camera, "_start", start)
            with closing(camera):
                async with asyncio.timeout(30.0):
                    await twice.wait()
        return faults, camera.starts

    faults, starts = asyncio.run(scenario())
    assert faults == ["the Kinect is being opened", f"{tmp_path} is not a recording: it has no readable INDEX.txt"]
    assert starts == 2


# --- recordings -------------------------------------------------------------------------------------


def test_a_recording_is_checked_before_it_is_played(tmp_path: Path) -> None:
    index = tmp_path / "INDEX.txt"
    depth, colour = tmp_path / "d-1.0-60.pgm", tmp_path / "r-1.0-60.ppm"
    depth.write_bytes(b"P5 640 480 65535\n" + bytes(DEPTH_BYTES))
    colour.write_bytes(b"P6 640 480 255\n" + bytes(COLOUR_BYTES))
    (tmp_path / "a-1.0-60.dump").write_bytes(b"")

    def fault(*names: str) -> str:
        index.write_text("\n".join(names) + "\n")
        with pytest.raises(DeviceError) as error:
            check_recording(str(tmp_path))
        return str(error.value)

    whole = (depth.name, colour.name)
    assert "lists no colour or no depth images" in fault(depth.name)
    assert "cannot be read (No such file or directory)" in fault(*whole, "d-2.0-61.pgm")
    assert "is not named like a file of a recording" in fault(*whole, "r-soon-61.ppm")
    assert "has an empty line" in fault(depth.name, "", colour.name)
    assert "a-1.0-60.dump is empty" in fault(*whole, "a-1.0-60.dump")
    index.write_text("\n".join(whole) + "\n")
    check_recording(str(tmp_path))
    depth.write_bytes(b"P5 640 480 65535" + bytes(DEPTH_BYTES))
    assert "is damaged" in fault(*whole)
