"""Debian's playback library for Kinect recordings: the installed one, or one that is unpacked for the tests.

Unpacking is `apt-get download` and `dpkg-deb -x` into a temporary folder. This changes nothing in the system and needs
no root, except to fetch missing package lists.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from services.kinect.freenect import PACKAGE, MissingLibraryError, find

APT = ("apt-get", "-q", "-o", "Acquire::Retries=0", "-o", "Acquire::http::Timeout=15")
DOWNLOAD_S, UPDATE_S = 30.0, 90.0


def player(folder: Path) -> str:
    """The library's path. Skips the test, with the reason, when the library is not available."""
    try:
        return find("", recording=True)
    except MissingLibraryError:
        pass
    if not shutil.which("apt-get") or not shutil.which("dpkg-deb"):
        pytest.skip(f"SKIPPED, NOT PROVEN HERE: {PACKAGE} is not installed, and this is no Debian to get it from")
    why = _download(folder)
    if why and os.geteuid() == 0:
        _run([*APT, "update"], folder, UPDATE_S)
        why = _download(folder)
    if why:
        pytest.skip(f"SKIPPED, NOT PROVEN HERE: {PACKAGE} is not installed and cannot be downloaded ({why})")
    for package in folder.glob(f"{PACKAGE}_*.deb"):
        _run(["dpkg-deb", "-x", str(package), str(folder)], folder, DOWNLOAD_S)
    found = sorted(folder.glob("usr/lib/*/fakenect/libfreenect.so.0.5"))
    if not found:
        pytest.skip(f"SKIPPED, NOT PROVEN HERE: no playback library in {PACKAGE}")
    return str(found[0])


def _download(folder: Path) -> str:
    """Download the library. Returns the reason for which it is not available; '' when it is."""
    return _run([*APT, "download", PACKAGE], folder, DOWNLOAD_S)


def _run(command: list[str], folder: Path, limit_s: float) -> str:
    """A short reason for a failure."""
    try:
        done = subprocess.run(
            command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return f"nothing in {limit_s:.0f} s"
    except OSError as error:
        return str(error)
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["it failed"])[-1]
