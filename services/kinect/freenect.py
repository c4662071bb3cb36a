"""libfreenect through ctypes: colour and raw depth images by callbacks, tilt motor, LED.

Uses the asynchronous API of libfreenect 0.5 (`libfreenect.h`), which the playback library fakenect has too. Needs only
the standard library, so that the process that talks to the device stays small.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from ctypes import CFUNCTYPE, POINTER, byref, c_char_p, c_double, c_int, c_int8, c_int16, c_int32, c_uint32, c_void_p
from glob import glob
from typing import Literal, NamedTuple

LIBRARY = "libfreenect.so.0.5"
PACKAGE = "libfreenect0.5"
"""Name of the package in Debian and Ubuntu. It contains the playback library too."""
PLAYERS = "/usr/lib/*/fakenect/" + LIBRARY
WIDTH, HEIGHT = 640, 480
COLOUR_BYTES, DEPTH_BYTES = WIDTH * HEIGHT * 3, WIDTH * HEIGHT * 2
TICKS_HZ = 60_000_000
"""Rate of the device's clock, whose lower 32 bits are the timestamps."""

MOTOR, CAMERA = 1, 2
MEDIUM = 1
RGB = DEPTH_11BIT = 0
LOG_ERROR = 1
LED = Literal["off", "green", "red", "yellow", "blink_green", "blink_red_yellow"]
LEDS: dict[LED, int] = {"off": 0, "green": 1, "red": 2, "yellow": 3, "blink_green": 4, "blink_red_yellow": 6}


ImageKind = Literal["colour", "depth"]
ImageCallback = Callable[[ImageKind, int, int], None]


class MissingLibraryError(Exception):
    """libfreenect is missing. The text names the package to install."""


class DeviceError(Exception):
    """The device or its library failed; the text is for people."""


class FrameMode(ctypes.Structure):
    """freenect_frame_mode."""

    _fields_ = (
        ("reserved", c_uint32),
        ("resolution", c_int32),
        ("format", c_int32),
        ("bytes", c_int32),
        ("width", c_int16),
        ("height", c_int16),
        ("data_bits_per_pixel", c_int8),
        ("padding_bits_per_pixel", c_int8),
        ("framerate", c_int8),
        ("is_valid", c_int8),
    )


class _TiltState(ctypes.Structure):
    """freenect_raw_tilt_state."""

    _fields_ = (("x", c_int16), ("y", c_int16), ("z", c_int16), ("angle", c_int8), ("status", c_int32))


class _Seconds(ctypes.Structure):
    """timeval."""

    _fields_ = (("seconds", ctypes.c_long), ("microseconds", ctypes.c_long))


class TiltReading(NamedTuple):
    """Angle of the tilt motor, and acceleration of a device at rest (x right, y up, z back)."""

    angle_deg: float
    acceleration_mps2: tuple[float, float, float]


FrameCallback = CFUNCTYPE(None, c_void_p, c_void_p, c_uint32)
LogCallback = CFUNCTYPE(None, c_void_p, c_int, c_char_p)

_PROTOTYPES: dict[str, tuple[object, tuple[object, ...]]] = {
    "freenect_init": (c_int, (POINTER(c_void_p), c_void_p)),
    "freenect_shutdown": (c_int, (c_void_p,)),
    "freenect_set_log_level": (None, (c_void_p, c_int)),
    "freenect_set_log_callback": (None, (c_void_p, LogCallback)),
    "freenect_select_subdevices": (None, (c_void_p, c_int)),
    "freenect_num_devices": (c_int, (c_void_p,)),
    "freenect_open_device": (c_int, (c_void_p, POINTER(c_void_p), c_int)),
    "freenect_close_device": (c_int, (c_void_p,)),
    "freenect_find_video_mode": (FrameMode, (c_int, c_int)),
    "freenect_find_depth_mode": (FrameMode, (c_int, c_int)),
    "freenect_set_video_mode": (c_int, (c_void_p, FrameMode)),
    "freenect_set_depth_mode": (c_int, (c_void_p, FrameMode)),
    "freenect_set_video_callback": (None, (c_void_p, FrameCallback)),
    "freenect_set_depth_callback": (None, (c_void_p, FrameCallback)),
    "freenect_start_video": (c_int, (c_void_p,)),
    "freenect_start_depth": (c_int, (c_void_p,)),
    "freenect_stop_video": (c_int, (c_void_p,)),
    "freenect_stop_depth": (c_int, (c_void_p,)),
    "freenect_process_events_timeout": (c_int, (c_void_p, POINTER(_Seconds))),
    "freenect_set_tilt_degs": (c_int, (c_void_p, c_double)),
    "freenect_set_led": (c_int, (c_void_p, c_int)),
    "freenect_update_tilt_state": (c_int, (c_void_p,)),
    "freenect_get_tilt_state": (POINTER(_TiltState), (c_void_p,)),
}


def find(library: str, recording: bool) -> str:
    """The library to load: `library` if given, else the player's for a recording, else the system's. Raises
    MissingLibraryError when the player is not installed."""
    if library:
        return library
    if not recording:
        return LIBRARY
    players = sorted(glob(PLAYERS))  # noqa: PTH207 # importing pathlib takes longer than loading the library
    if not players:
        raise MissingLibraryError(f"the player of recordings is not installed: sudo apt install {PACKAGE}")
    return players[0]


def load(path: str) -> ctypes.CDLL:
    """Load the library and declare its functions' types. Raises MissingLibraryError."""
    try:
        library = ctypes.CDLL(path)
        for name, (result, arguments) in _PROTOTYPES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except OSError as error:
        missing = path == LIBRARY or "libusb" in str(error)
        problem = "is not installed" if missing else f"{path} cannot be loaded ({error})"
        raise MissingLibraryError(f"libfreenect {problem}: sudo apt install {PACKAGE}") from error
    except AttributeError as error:
        raise MissingLibraryError(f"{path} is no libfreenect 0.5 ({error}): sudo apt install {PACKAGE}") from error
    return library


class FreenectDevice:
    """The first device that is found, open and streaming.

    `process` calls `on_image(kind, address, ticks)` with each image; its pixels are valid until the callback returns.
    Raises DeviceError when there is no device, or when it cannot be opened or streamed from.
    """

    def __init__(self, library: ctypes.CDLL, on_image: ImageCallback) -> None:
        self._library = library
        self.log = ""
        """Newest error message of the library."""
        self._context, self._device = c_void_p(), c_void_p()
        # ctypes keeps no reference to a callback, so this object must.
        self._callbacks = (
            FrameCallback(lambda _, pixels, ticks: on_image("colour", pixels, ticks)),
            FrameCallback(lambda _, pixels, ticks: on_image("depth", pixels, ticks)),
            LogCallback(self._logged),
        )
        if library.freenect_init(byref(self._context), None) < 0:
            raise DeviceError("USB cannot be used: the library would not start")
        try:
            self._open()
            self._start()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        library, context = self._library, self._context
        library.freenect_set_log_level(context, LOG_ERROR)
        library.freenect_set_log_callback(context, self._callbacks[2])
        if library.freenect_num_devices(context) <= 0:
            raise DeviceError("no Kinect is found: is it plugged in, and does it have its own 12 V supply?")
        for parts in (MOTOR | CAMERA, CAMERA):  # the motor of later models needs firmware, their cameras do not
            library.freenect_select_subdevices(context, parts)
            if library.freenect_open_device(context, byref(self._device), 0) >= 0:
                self.has_motor = bool(parts & MOTOR)
                return
            self._device = c_void_p()
        raise DeviceError(
            f"the Kinect cannot be opened: does another program use it, are you in the group plugdev?{self._log_suffix}"
        )

    def _start(self) -> None:
        library, device = self._library, self._device
        colour = library.freenect_find_video_mode(MEDIUM, RGB)
        depth = library.freenect_find_depth_mode(MEDIUM, DEPTH_11BIT)
        if (colour.bytes, depth.bytes) != (COLOUR_BYTES, DEPTH_BYTES):
            raise DeviceError(f"the library has pictures of {colour.bytes} and {depth.bytes} bytes: it is another one")
        library.freenect_set_video_callback(device, self._callbacks[0])
        library.freenect_set_depth_callback(device, self._callbacks[1])
        for code in (
            library.freenect_set_video_mode(device, colour),
            library.freenect_set_depth_mode(device, depth),
            library.freenect_start_depth(device),
            library.freenect_start_video(device),
        ):
            if code < 0:
                raise DeviceError(f"the Kinect's streams cannot be started (code {code}){self._log_suffix}")

    def process(self, wait_s: float) -> int:
        """Wait for images and pass them to the callback. Negative when the stream has ended, as when it is
        unplugged."""
        wait = _Seconds(0, round(wait_s * 1e6))
        code: int = self._library.freenect_process_events_timeout(self._context, byref(wait))
        return code

    def tilt(self, angle_deg: float) -> None:
        if self.has_motor:
            self._library.freenect_set_tilt_degs(self._device, angle_deg)

    def led(self, led: LED) -> None:
        if self.has_motor:
            self._library.freenect_set_led(self._device, LEDS[led])

    def read_tilt(self) -> TiltReading | None:
        """The tilt motor's state; None when there is no motor or it does not answer."""
        if not self.has_motor or self._library.freenect_update_tilt_state(self._device) < 0:
            return None
        state = self._library.freenect_get_tilt_state(self._device).contents
        x, y, z = (count * 9.80665 / 819.0 for count in (state.x, state.y, state.z))  # FREENECT_COUNTS_PER_G
        return TiltReading(state.angle / 2.0, (x, y, z))

    def close(self) -> None:
        library = self._library
        if self._device:
            library.freenect_stop_video(self._device)
            library.freenect_stop_depth(self._device)
            library.freenect_close_device(self._device)
            self._device = c_void_p()
        if self._context:
            library.freenect_shutdown(self._context)
            self._context = c_void_p()

    @property
    def _log_suffix(self) -> str:
        return f" ({self.log})" if self.log else ""

    def _logged(self, _: int, level: int, text: bytes) -> None:
        if level <= LOG_ERROR:
            self.log = text.decode(errors="replace").strip()


INDEX = "INDEX.txt"
BYTES = {"r": COLOUR_BYTES, "d": DEPTH_BYTES}
LONGEST_HEADER = 64
"""One line of a PPM or PGM."""


def check_recording(folder: str) -> None:
    """Check that a fakenect recording is complete, since its player reads beyond the end of a short file. Raises
    DeviceError that names the damaged file and says what to do."""
    index = os.path.join(folder, INDEX)  # noqa: PTH118 # pathlib is slow to import
    try:
        with open(index, encoding="utf-8") as file:  # noqa: PTH123
            names = file.read().splitlines()
    except (OSError, UnicodeDecodeError):
        raise DeviceError(f"{folder} is not a recording: it has no readable {INDEX}") from None
    if not {"r", "d"} <= {name[:1] for name in names}:
        raise DeviceError(f"{index} lists no colour or no depth images: the recording has nothing to play")
    for fault in _faults(folder, names):
        raise DeviceError(f"{fault}: record again, or remove its line from {index}")


def _faults(folder: str, names: list[str]) -> Iterator[str]:
    for name in names:
        path = os.path.join(folder, name)  # noqa: PTH118
        if not name:
            yield f"{folder}: {INDEX} has an empty line"
        elif not _is_valid_name(name):
            yield f"{path} is not named like a file of a recording"
        else:
            yield from _wrong_size(path, name[0])


def _is_valid_name(name: str) -> bool:
    """Whether a name is TYPE-SECONDS-TICKS.anything."""
    parts = name.split(".pgm")[0].split(".ppm")[0].split(".dump")[0].split("-")
    try:
        return len(parts) == 3 and parts[0] in ("r", "d", "a") and float(parts[1]) >= 0 and int(parts[2]) >= 0
    except ValueError:
        return False


def _wrong_size(path: str, kind: str) -> Iterator[str]:
    try:
        with open(path, "rb") as file:  # noqa: PTH123
            header = file.readline(LONGEST_HEADER)
            size = file.seek(0, os.SEEK_END)
    except OSError as error:
        yield f"{path} cannot be read ({error.strerror})"
        return
    if kind not in BYTES:
        if size == 0:
            yield f"{path} is empty"
    elif not header.endswith(b"\n") or size != len(header) + BYTES[kind]:
        yield f"{path} is damaged: its pixels take {size - len(header)} bytes, not {BYTES[kind]}"
