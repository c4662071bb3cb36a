"""`cocoro echo KEY`: prints the messages of a key, of any type."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from typing import Any

from apps.cli import exits
from apps.cli.foreign import HEAD, DecodedPayload, jsonable, lines, read
from apps.cli.interrupt import interrupt_event
from apps.cli.link import joined
from apps.cli.listening import Ear, Heard, keyexpr_of, takes_frames
from apps.cli.options import RobotChoice

HINT_S = 3.0
"""After this time without a message a hint is printed."""


async def echo(
    where: RobotChoice, text: str, count: int | None, seconds: float | None, as_json: bool, everything: bool
) -> int:
    """Print until interrupted, `count` messages, or for `seconds`. Returns exit code 1 when the time ended before the
    first message, or before `count` messages."""
    async with joined(where, frames=takes_frames(text)) as link:
        ear = Ear(link, keyexpr_of(text, link.robot))
        with interrupt_event() as end:
            printed = await _print(ear, link.robot, end, count, seconds, as_json, everything)
            interrupted = end.is_set()
        if ear.dropped:
            print(f"cocoro: {ear.dropped} messages arrived too fast and were not printed", file=sys.stderr)
    enough = printed >= (count or 1)
    return exits.DONE if interrupted or enough else exits.FAILED


async def _print(
    ear: Ear, robot: str, end: asyncio.Event, count: int | None, seconds: float | None, as_json: bool, everything: bool
) -> int:
    """Print messages; returns their number."""
    printed, hinted = 0, False
    started_s = time.monotonic()
    while not end.is_set() and (count is None or printed < count):
        left_s = None if seconds is None else started_s + seconds - time.monotonic()
        if left_s is not None and left_s <= 0:
            break
        wait_s = left_s if hinted or printed else min(HINT_S, left_s or HINT_S)
        if not await ear.wait(end, wait_s):
            if not (printed or hinted or end.is_set()) and (left_s is None or left_s > HINT_S):
                hinted = True
                print(f"nothing on {ear.keyexpr} yet; `cocoro topics` lists the topics, `cocoro top` the live ones",
                      file=sys.stderr)  # fmt: skip
            continue
        for heard in ear.take()[: None if count is None else count - printed]:
            reading = read(heard.payload, heard.key.removeprefix(f"{robot}/"))
            print(_as_json(heard, reading) if as_json else _as_text(heard, reading, everything), flush=True)
            printed += 1
    return printed


def _as_json(heard: Heard, reading: DecodedPayload) -> str:
    entry = {"key": heard.key, "type": reading.type or None, "message": jsonable(reading.value)}
    return json.dumps(entry | ({"problem": reading.problem} if reading.problem else {}))


def _as_text(heard: Heard, reading: DecodedPayload, everything: bool) -> str:
    value = reading.value
    head: dict[Any, Any] = value if isinstance(value, dict) else {}
    title = [heard.key, reading.type or "(unknown type)"]
    if isinstance(seq := head.get("seq"), int):
        title.append(f"#{seq}")
    if isinstance(stamp_ns := head.get("stamp_ns"), int):
        title.append(f"{stamp_ns / 1e9:.3f} s")
    told = [f"! {reading.problem}"] if reading.problem else []
    if isinstance(value, dict):
        rest = {key: item for key, item in value.items() if key not in HEAD}
        return "\n".join(["  ".join(title), *told, *lines(rest, everything)])
    return "\n".join(["  ".join(title), *told, *([] if value is None else lines(value, everything))])
