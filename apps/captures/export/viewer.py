"""Rerun's viewer: a window here, a page for a browser, a viewer elsewhere, or a file for one.

Rerun's library waits for ever in each call when the viewer takes nothing any more. So what is logged to a viewer is
logged in a thread that nobody waits for without a limit.
"""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Generic, TypeVar
from urllib.parse import quote, urlsplit

import msgspec

from cocoro.capture.conventions import CaptureError
from cocoro.child import wait_or_kill
from cocoro.errors import ConfigError

LOOPBACK = "127.0.0.1"
DATA_PORT, PAGE_PORT = 9876, 9090
"""Rerun's own ports; others are taken where these are in use."""
START_S = 20.0
"""Longest time until a started viewer accepts data."""
END_S = 3.0
STALLED_S = 15.0
"""A viewer that takes nothing for this long is given up."""
CONNECT_S = 3.0
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
INSTEAD = "--web shows it in a browser, --save OUT.rrd writes a file, --connect HOST sends it to a viewer elsewhere"


class Target(msgspec.Struct, frozen=True, kw_only=True):
    """The viewer or file that gets a scene: at most one of `save`, `web` and `connect`; without them a window."""

    save: Path | None = None
    web: bool = False
    bind: str = LOOPBACK
    """The address that the page is served on."""
    connect: str | None = None
    """HOST, HOST:PORT or the whole address of a viewer that runs."""

    def check(self) -> None:
        """Raises ConfigError when more than one way is chosen, or the window has no display."""
        if (self.save is not None) + self.web + (self.connect is not None) > 1:
            raise ConfigError("--save, --web and --connect exclude each other; choose one")
        if self.bind != LOOPBACK and not self.web:
            raise ConfigError("--bind is the address of the page that --web serves; give --web too")
        in_window = self.save is None and not self.web and self.connect is None
        if in_window and sys.platform == "linux" and not any(os.environ.get(name) for name in DISPLAYS):
            raise ConfigError(f"there is no display here for a window (DISPLAY is not set): {INSTEAD}")


def address_of(viewer: str) -> tuple[str, str, int]:
    """Rerun's address, the host and the port of `viewer`, as `--connect` takes it. Raises ConfigError."""
    whole = viewer if "://" in viewer else f"rerun+http://{viewer}/proxy"
    try:
        parts = urlsplit(whole)
        host, port = parts.hostname, parts.port or DATA_PORT
    except ValueError:
        host, port = None, 0
    if not host or parts.scheme not in ("rerun", "rerun+http", "rerun+https"):
        raise ConfigError(f"--connect {viewer}: write HOST, HOST:PORT or rerun+http://HOST:PORT/proxy")
    named = f"[{host}]" if ":" in host else host
    return (whole if "://" in viewer else f"rerun+http://{named}:{port}/proxy"), host, port


def refuse_nobody(viewer: str) -> str:
    """Rerun's address of a viewer that listens. Raises ConfigError for no address, CaptureError when none listens."""
    address, host, port = address_of(viewer)
    try:
        socket.create_connection((host, port), CONNECT_S).close()
    except OSError as error:
        why = error.strerror or error
        raise CaptureError(
            f"no viewer listens at {host} port {port} ({why}); start one there with `rerun --bind {host}`"
        ) from error
    return address


# --- a viewer of our own --------------------------------------------------------------------------


class ViewerProcess:
    """Rerun's program, which ends with this object's `close`. Raises CaptureError when it does not start."""

    def __init__(self, target: Target, file: Path | None = None) -> None:
        """Shows a file, or else what is sent to `address`."""
        data_port = free_port(DATA_PORT, target.bind)
        options = ["--bind", target.bind, "--port", str(data_port), "--server-memory-limit", "50%"]
        self.address = f"rerun+http://{_reached(target.bind)}:{data_port}/proxy"
        self.page = ""
        """Address of the page; '' for a window."""
        if target.web:
            page_port = free_port(PAGE_PORT, target.bind)
            host = socket.gethostname() if target.bind in ("0.0.0.0", "::") else target.bind
            self.page = f"http://{host}:{page_port}/?url={quote(f'rerun+http://{host}:{data_port}/proxy', safe='')}"
            options += ["--serve-web", "--web-viewer-port", str(page_port)]
            if target.bind != LOOPBACK:
                options += ["--cors-allow-origin", f"http://*:{page_port}"]
        elif file is None:
            options.append("--expect-data-soon")
        self._port = data_port
        self._was_ready = False
        self._bind = target.bind
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 # closed by `close`
        command = [_program(), *([str(file)] if file is not None else []), *options]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=self._said, stderr=self._said, start_new_session=True
            )
        except OSError as error:
            self._said.close()
            raise CaptureError(f"Rerun's viewer does not start: {error.strerror}; {INSTEAD}") from error

    def wait_until_ready(self) -> None:
        """Wait until it takes data. Raises CaptureError when it ends before, or takes too long."""
        until_s = time.monotonic() + START_S
        while time.monotonic() < until_s:
            if self.ended:
                raise CaptureError(self.reason())
            with suppress(OSError):
                socket.create_connection((_reached(self._bind), self._port), 1.0).close()
                self._was_ready = True
                return
            time.sleep(0.05)
        raise CaptureError(f"Rerun's viewer takes no data within {START_S:.0f} s; {INSTEAD}")

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    @property
    def failed(self) -> bool:
        """Whether it ended by an error, not because its window was closed."""
        return self._process.poll() not in (None, 0)

    def reason(self) -> str:
        """The viewer's last words, which say why it ended."""
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").splitlines()
        errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
        why = f": {errors[-1].rpartition('.rs:')[2].partition(': ')[2] or errors[-1]}" if errors else ""
        if self._was_ready:
            return f"Rerun's viewer has ended{why or f' with exit code {self._process.returncode}'}"
        return f"Rerun's viewer could not be opened{why}; {INSTEAD}"

    def wait(self) -> None:
        """Wait until the viewer ends. Raises CaptureError when it ended by an error."""
        self._process.wait()
        if self.failed:
            raise CaptureError(self.reason())

    def close(self) -> None:
        self._process.terminate()
        wait_or_kill(self._process, END_S)
        self._said.close()

    def __enter__(self) -> ViewerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def free_port(wanted: int, bind: str) -> int:
    """The wanted port if it is free, else another one. Raises ConfigError for an address that is not this machine's."""
    for port in (wanted, 0):
        try:
            with socket.create_server((bind, port), family=socket.AF_INET6 if ":" in bind else socket.AF_INET) as made:
                return int(made.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
    raise ConfigError(f"--bind {bind}: {reason}; 127.0.0.1 serves this machine alone, 0.0.0.0 every address")


def _reached(bind: str) -> str:
    """The address by which this machine reaches a server that is bound to an address."""
    return LOOPBACK if bind == "0.0.0.0" else "[::1]" if bind == "::" else bind


def _program() -> str:
    """Rerun's program. Its Python launcher would stay between, and leave it running when it is ended."""
    spec = importlib.util.find_spec("rerun_cli")
    folders = [] if spec is None else list(spec.submodule_search_locations or ())
    for folder in folders:
        for name in ("rerun", "Rerun.app/Contents/MacOS/Rerun"):
            if (path := Path(folder, name)).is_file():
                return str(path)
    return "rerun"


# --- logging without waiting for ever -------------------------------------------------------------

R = TypeVar("R")


class Attempt(Generic[R]):
    """Work in a thread of its own, which may never end. The process does not wait for it."""

    def __init__(self, work: Callable[[], R]) -> None:
        self._work = work
        self._result: list[R] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="rerun", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._result.append(self._work())
        except BaseException as error:
            self._error = error

    def join(self, patience_s: float) -> bool:
        """Wait at most so long; returns whether it has ended."""
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def result(self) -> R:
        """The result of the work, once it has ended. Raises the work's error, and CaptureError for one of Rerun's."""
        if isinstance(self._error, RuntimeError | OSError):
            raise CaptureError(f"not all was taken: {self._error}") from self._error
        if self._error is not None:
            raise self._error
        return self._result[0]


class Pulse:
    """The time of the last sign of progress of something that another thread watches."""

    def __init__(self) -> None:
        self._newest_s = time.monotonic()

    def beat(self) -> None:
        self._newest_s = time.monotonic()

    @property
    def still_s(self) -> float:
        return time.monotonic() - self._newest_s


def sent(work: Callable[[Pulse], R], where: str) -> R:
    """The result of work that logs to a viewer and beats while it goes on. Raises CaptureError when it stalls."""
    pulse = Pulse()
    attempt = Attempt(lambda: work(pulse))
    while not attempt.join(0.2):
        if pulse.still_s > STALLED_S:
            raise CaptureError(f"the viewer at {where} has taken nothing for {STALLED_S:.0f} s, or has gone")
    return attempt.result()


@contextmanager
def temporary_rrd() -> Iterator[Path]:
    """The path for a file that is there while the context lasts. Raises CaptureError when there is no room for one."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="cocoro-view-")
    except OSError as error:
        raise CaptureError(f"{tempfile.gettempdir()}: {error.strerror}; choose another place by TMPDIR") from error
    with folder as path:
        yield Path(path) / "view.rrd"
