"""The place of the mesh, and how a process joins it: without multicast, daemon or discovery.

On one machine the mesh is a directory. Each process listens on a Unix socket in it and connects to all processes that
joined before (see `cocoro.bus.register`). So all pairs are connected directly, with the least latency, and no single
process can take the mesh down. Two robots have two directories and never meet. The directory is its owner's alone, so
no other user can drive the robot. Across machines, `client` mode goes through routers.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cocoro.errors import ConfigError
from cocoro.private import RUN_DIR, default_run_dir

LONGEST_SOCKET_PATH = 100
"""Bytes; the kernel takes 107 on Linux and 103 on macOS."""
FORBIDDEN = "#?;"
"""Characters that end the path in a zenoh endpoint."""


@dataclass(frozen=True)
class ZenohConfig:
    """One process's way into the mesh: a directory, or endpoints such as 'tcp/127.0.0.1:7447', never both.

    Raises ConfigError for a combination or a directory that cannot be used.
    """

    name: str
    """The process's name in the register and in logs."""
    directory: Path | None = None
    mode: Literal["peer", "client", "router"] = "peer"
    """A client communicates through the router that it connects to. A peer communicates with the processes that it
    connects to or that connect to it, and discovers no others."""
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    lease_s: float = 4.0
    """Time of silence (stopped, cut off) after which liveliness tokens drop; those of a killed process drop at once."""
    patience_s: float = 1.0
    """Longest wait for the mesh, or for a member that does not answer, when joining."""
    shared_memory: bool = False
    """Whether the process publishes or reads frames, which travel in shared memory where there is any."""
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
                raise ConfigError(f"mesh directory {path}: the path must be UTF-8, choose another by {RUN_DIR}")
        elif not self.listen and not self.connect:
            raise ConfigError(f"mesh of {self.name}: give a directory, or endpoints to listen on or connect to")

    @property
    def where(self) -> str:
        """The mesh's place, for error messages."""
        return str(self.directory) if self.directory else ", ".join(self.connect or self.listen)


def default(robot: str, name: str, run_dir: Path | None = None) -> ZenohConfig:
    """The mesh of a robot on this machine: the robot's directory in the run directory (`default_run_dir` by default).

    Raises ConfigError for a robot name that cannot be part of a path and of a key.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", robot):
        raise ConfigError(f"robot name {robot!r}: use letters, digits, '_', '-' and '.', and begin with no sign")
    return ZenohConfig(name=name, directory=(run_dir or default_run_dir()) / robot)
