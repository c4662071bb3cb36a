"""Where the mesh is, and how a process gets into it: no multicast, no daemon, no guessing.

On one machine the mesh is a directory. Every process listens on a Unix socket there and connects to all that came
before it (see `members`), so all of them hear each other directly, at the least latency, and there is no process
whose death takes the mesh with it. Two robots have two directories and never meet; the directory is its owner's
alone, so nobody else on the machine can drive the robot. Across machines, `client` mode speaks through routers.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cocoro.errors import ConfigError

LONGEST_SOCKET_PATH = 100
"""Bytes; the kernel takes 107 on Linux and 103 on macOS."""
FORBIDDEN = "#?;"
"""What would end the path in an endpoint."""


@dataclass(frozen=True)
class ZenohConfig:
    """How one process joins. Either a directory, or endpoints such as 'tcp/127.0.0.1:7447', never both."""

    name: str
    """What the process is called in the register and in logs."""
    directory: Path | None = None
    mode: Literal["peer", "client", "router"] = "peer"
    """A client speaks through the router that it connects to. A peer speaks with just those that it connects to or
    that connect to it: nobody is discovered."""
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    lease_s: float = 4.0
    """How long a process may be silent (stopped, cut off) before its liveliness tokens drop. A killed one's drop
    at once."""
    patience_s: float = 1.0
    """How long opening waits for the mesh, and for a member of it that does not answer."""
    shared_memory: bool = False
    """Whether it publishes frames or reads them: then they travel in shared memory, where that can be had."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further zenoh options by path ('transport/link/tls/...'), for certificates and access control."""

    def __post_init__(self) -> None:
        if self.directory is not None:
            if self.mode != "peer" or self.listen or self.connect:
                raise ConfigError(f"mesh of {self.name}: a directory goes without mode, listen and connect")
            path = str(self.directory)
            if len(os.fsencode(path)) > LONGEST_SOCKET_PATH - len("/0123456789abcdef.sock"):
                raise ConfigError(f"mesh directory {path}: the path is too long for a Unix socket, choose a shorter")
            if any(c in path for c in FORBIDDEN):
                raise ConfigError(f"mesh directory {path}: the path may not contain any of {FORBIDDEN}")
            if any("\udc80" <= c <= "\udcff" for c in path):
                raise ConfigError(f"mesh directory {path}: the path must be UTF-8, choose another by COCORO_RUN_DIR")
        elif not self.listen and not self.connect:
            raise ConfigError(f"mesh of {self.name}: say a directory, or where to listen or connect")

    @property
    def where(self) -> str:
        """In words, for errors."""
        return str(self.directory) if self.directory else ", ".join(self.connect or self.listen)


def default(robot: str, name: str, run_dir: Path | None = None) -> ZenohConfig:
    """The mesh of a robot that lives on this machine: a directory for it below the run directory.

    The run directory is, in this order: the argument, $COCORO_RUN_DIR, `cocoro` in $XDG_RUNTIME_DIR, a directory
    of this user's in the system's place for temporary files. What is in it must be this user's alone (see
    `cocoro.private`).
    Raises ConfigError for a robot's name that cannot be part of a path and of a key.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", robot):
        raise ConfigError(f"robot name {robot!r}: use letters, digits, '_', '-' and '.', and begin with no sign")
    return ZenohConfig(name=name, directory=(run_dir or default_run_dir()) / robot)


def default_run_dir() -> Path:
    if explicit := os.environ.get("COCORO_RUN_DIR"):
        return Path(explicit).absolute()
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "cocoro"
    return Path(tempfile.gettempdir()) / f"cocoro-{os.getuid()}"
