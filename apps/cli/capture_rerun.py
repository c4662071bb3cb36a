"""`cocoro capture rerun`: does a service still do what it did?"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import msgspec

from apps.captures import reexecute as rerunning
from apps.cli import exits
from cocoro.capture.errors import CaptureError
from cocoro.capture.reader import Capture
from cocoro.errors import ConfigError


def rerun(files: list[Path], service: str, against: str, tolerance: float, as_json: bool) -> int:
    """Raises CaptureError when the captures do not have what that takes."""
    if against not in ("recorded", "nothing"):
        raise ConfigError(f"--against {against}: known are recorded and nothing")
    with ExitStack() as stack:
        captures = [stack.enter_context(Capture.open(file)) for file in files]
        if len({capture.robot for capture in captures}) > 1:
            raise CaptureError("these captures are of several robots")
        result = rerunning.rerun(captures, service, tolerance, compare=against == "recorded")
    for capture in captures:
        if capture.ending:
            print(f"note: {capture.path} was {capture.ending}", file=sys.stderr)
    if as_json:
        print(msgspec.json.encode(result).decode())
    else:
        print("\n".join(rerunning.words(result)))
    bad = result.differing or result.problems or (against == "recorded" and not result.equal)
    return exits.FAILED if bad else exits.DONE
