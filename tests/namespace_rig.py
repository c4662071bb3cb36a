"""A mount namespace with small file systems, for tests of full disks."""

from __future__ import annotations

import os
import shutil
import subprocess
from functools import cache
from pathlib import Path
from types import TracebackType

import pytest

FULL_BYTES = 1 << 30
"""More than the capacity of any file system of these tests."""


class Namespace:
    """A context manager. A command with `prefix` runs in the namespace. Skips the test where it cannot be made."""

    def __init__(self, mounts: dict[Path, str]) -> None:
        """`mounts`: the places that get a tmpfs, each with its options, such as 'size=1m'."""
        lines = [f"mount -t tmpfs -o {options} tmpfs {place}" for place, options in mounts.items()]
        script = " && ".join(["mount --make-rprivate /", *lines, "echo ready", "exec sleep infinity"])
        self._process = subprocess.Popen(
            ["unshare", "-m", "sh", "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Namespace:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        if self._process.stdout.readline() != "ready\n":
            why = self._process.stderr.read().strip()
            self._end()
            pytest.skip(f"no mount namespace here: {why}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _end(self) -> None:
        self._process.kill()
        self._process.communicate()

    @property
    def prefix(self) -> list[str]:
        return ["nsenter", "--target", str(self._process.pid), "--mount", f"--wd={Path.cwd()}", "--"]

    def at(self, path: Path) -> Path:
        """The path by which a path of the namespace is reached from outside."""
        return Path(f"/proc/{self._process.pid}/root") / path.relative_to("/")

    def fill(self, place: Path) -> Path:
        """Fill the remaining space with a file; returns its path from outside."""
        filler = self.at(place) / "filler"
        with filler.open("wb", buffering=0) as file:
            for block in (1 << 20, 4096, 1):
                try:
                    while file.tell() < FULL_BYTES:
                        file.write(bytes(block))
                except OSError:
                    continue
        return filler


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a file system")


@cache
def no_namespaces() -> str:
    """The reason for which there are no namespaces to be had, or ''."""
    if shutil.which("unshare") is None:
        return "there is no unshare"
    command = ["unshare", "--mount", "--net", "mount", "--make-rprivate", "/"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stderr.strip()
