"""`cocoro view`: Rerun, on a capture or live on the mesh."""

from __future__ import annotations

import asyncio
import signal
from functools import partial
from pathlib import Path
from typing import Any

from cocoro.capture.export.rerun_scene import APPLICATION, Teller, library, tell
from cocoro.capture.reader import Capture
from cocoro.cli import exits
from cocoro.cli.link import Where, joined
from cocoro.messages import Message
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import TOPICS

PER_SERVICE = "{service}"


def view_file(file: Path) -> int:
    """Open Rerun on a capture. Raises CaptureError when Rerun is not installed."""
    rr = library()
    with Capture.open(file) as capture:
        recording = rr.RecordingStream(APPLICATION)
        recording.spawn()
        print(f"{tell(capture, recording)} messages are in Rerun")
        recording.flush()
        return exits.FAILED if capture.problems else exits.DONE


async def view_mesh(where: Where) -> int:
    """Open Rerun on the mesh, until Ctrl-C. Raises CaptureError when Rerun is not installed, MeshError for no mesh."""
    rr = library()
    async with joined(where) as link:
        resolved = link.run_dir.resolved()
        description, measured = (_path(resolved.get(name)) for name in ("description", "measured"))
        recording = rr.RecordingStream(APPLICATION)
        recording.spawn()
        teller = Teller(recording, Robot.load(description, measured), Catalogue.load())
        for topic in TOPICS:
            if PER_SERVICE not in topic.name:
                link.inbox(topic).add(partial(_heard, teller, topic.name))
        print("Ctrl-C ends it")
        end, loop = asyncio.Event(), asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, end.set)
        await end.wait()
    return exits.DONE


def _heard(teller: Teller, topic: str, _key: str, message: Message) -> None:
    teller.tell(topic, message)


def _path(file: Any) -> Path | None:
    return None if file is None else Path(file)
