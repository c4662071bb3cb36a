"""`cocoro view`: Rerun, on a capture or live on the mesh."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from apps.captures.export.rerun_scene import Teller, library, no_viewer, opened, tell
from apps.cli import exits
from apps.cli.ending import told_to_end
from apps.cli.link import joined
from apps.cli.options import RobotChoice
from cocoro.bus.base import Bus, Payload
from cocoro.capture.reader import Capture
from cocoro.messages import Message
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import TOPICS, Topic

PER_SERVICE = "{service}"
WAITING = 4
"""Messages of a key; a viewer that is behind shows the newest."""


def view_file(file: Path) -> int:
    """Open Rerun on a capture. Raises CaptureError when Rerun is not installed, or cannot be opened."""
    rr = library()
    with Capture.open(file) as capture:
        recording = opened(rr)
        with no_viewer():
            count = tell(capture, recording)
            recording.flush()
        print(f"{count} messages are in Rerun")
        return exits.FAILED if capture.problems else exits.DONE


async def view_mesh(where: RobotChoice) -> int:
    """Open Rerun on the mesh, until Ctrl-C. Raises CaptureError when Rerun is not installed, MeshError for no mesh."""
    rr = library()
    async with joined(where, frames=True) as link:
        resolved = link.run_dir.resolved()
        description, measured = (_path(resolved.get(name)) for name in ("description", "measured"))
        recording = opened(rr)
        watch(link.bus, link.robot, Teller(recording, Robot.load(description, measured), Catalogue.load()))
        print("Ctrl-C ends it")
        with told_to_end() as end:
            await end.wait()
    return exits.DONE


def watch(bus: Bus, robot: str, teller: Teller) -> None:
    """Tell of everything that travels from now on, however old it is: a viewer acts on nothing."""

    def heard(topic: Topic[Any], decoder: msgspec.msgpack.Decoder[Message], _key: str, payload: Payload) -> None:
        with suppress(msgspec.MsgspecError, ValueError, RecursionError):
            teller.tell(topic.name, decoder.decode(payload))

    for topic in TOPICS:
        if PER_SERVICE not in topic.name:
            handler = partial(heard, topic, msgspec.msgpack.Decoder(topic.type))
            bus.subscribe(topic.key(robot), topic.qos, handler, depth=WAITING)


def _path(file: Any) -> Path | None:
    return None if file is None else Path(file)
