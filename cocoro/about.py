"""What a service is and what it was started with, for those who record it or want to make its core again."""

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

from cocoro.clock import VirtualClock
from cocoro.messages import AboutFile, AboutReply
from cocoro.objects import DEFAULT_FILE

if TYPE_CHECKING:
    from cocoro.node import Node

LARGEST_FILE = 1024 * 1024
"""Bytes; of a larger one only the fingerprint is told."""
DISTRIBUTIONS = ("cocoro-mesh", "eclipse-zenoh", "msgspec", "numpy", "scipy", "opencv-python-headless")
"""Whose versions the results of a computation may hang on."""


def about(node: Node) -> AboutReply:
    virtual = isinstance(node.clock, VirtualClock)  # then everything is the same at each run
    return AboutReply(
        service=node.name,
        robot=node.robot_name,
        module=node.module,
        config=msgspec.to_builtins(node.config),
        description=node.robot.to_data(),
        latency_s=node.latency_s,
        record_steps=node.record_steps,
        pid=0 if virtual else os.getpid(),
        host="" if virtual else socket.gethostname(),
        versions=versions(),
        files=tuple(_files(node.config)),
    )


@cache
def versions() -> dict[str, str]:
    """Of Python, the machine and the libraries."""
    found = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    for name in DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _files(config: Any) -> Iterator[AboutFile]:
    """The files that a configuration names; for the known objects the project's own, where it names none."""
    if not isinstance(config, msgspec.Struct):
        return
    for field, value in msgspec.structs.asdict(config).items():
        if isinstance(value, str) and value and Path(value).is_file():
            yield _file(field, value, Path(value).read_bytes())
        elif value is None and field == "objects":
            yield _file(field, DEFAULT_FILE, resources.files("cocoro").joinpath(DEFAULT_FILE).read_bytes())


def _file(field: str, path: str, content: bytes) -> AboutFile:
    fingerprint = hashlib.sha256(content).hexdigest()
    told = content if len(content) <= LARGEST_FILE else b""
    return AboutFile(field=field, path=path, sha256=fingerprint, content=told)
