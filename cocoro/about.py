"""Description of a service and of its start: enough to record it and to make its core again."""

from __future__ import annotations

import hashlib
import os
import platform
import socket
from collections.abc import Iterator
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from cocoro.messages import AboutFile, AboutReply
from cocoro.objects import DEFAULT_FILE

if TYPE_CHECKING:
    from cocoro.robot import Robot  # imports numpy, which is slow

LARGEST_FILE = 1024 * 1024
"""Bytes; of a larger file only the fingerprint is reported."""
DISTRIBUTIONS = ("cocoro-mesh", "eclipse-zenoh", "msgspec", "numpy", "scipy", "opencv-python-headless")
"""Distributions whose versions may change the results of a computation."""


def about(
    service: str, robot_name: str, robot: Robot, *, module: str, config: Any, record_steps: bool, virtual: bool
) -> AboutReply:
    """Make a service's reply about itself. With `virtual` time, process and host are left out, so that two equal runs
    give equal replies."""
    return AboutReply(
        service=service,
        robot=robot_name,
        module=module,
        config=msgspec.to_builtins(config),
        description=robot.to_data(),
        record_steps=record_steps,
        pid=0 if virtual else os.getpid(),
        host="" if virtual else socket.gethostname(),
        versions=versions(),
        files=tuple(_files(config)),
    )


@cache
def versions() -> dict[str, str]:
    """Versions of Python, the machine, the system and `DISTRIBUTIONS`, by name."""
    found = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    for name in DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _files(config: Any) -> Iterator[AboutFile]:
    """The files that a configuration names; the project's own file of known objects where it names none."""
    if not isinstance(config, msgspec.Struct):
        return
    for field, value in msgspec.structs.asdict(config).items():
        if isinstance(value, str) and value and Path(value).is_file():
            yield _file(field, value, Path(value).read_bytes())
        elif value is None and field == "objects":
            yield _file(field, DEFAULT_FILE, resources.files("cocoro").joinpath(DEFAULT_FILE).read_bytes())


def _file(field: str, path: str, content: bytes) -> AboutFile:
    fingerprint = hashlib.sha256(content).hexdigest()
    reported = content if len(content) <= LARGEST_FILE else b""
    return AboutFile(field=field, path=path, sha256=fingerprint, content=reported)
