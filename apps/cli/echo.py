"""`cocoro echo KEY`: prints the messages of a key, of any type, with what a reader would reject."""

from __future__ import annotations

import asyncio
import json as json_module
import math
import sys
import time
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import msgpack
import msgspec
import typer

from apps.cli import exits
from apps.cli.interrupt import interrupt_event
from apps.cli.link import joined
from apps.cli.listening import KeyListener, ReceivedPayload, keyexpr_of, nothing_on, takes_frames
from apps.cli.options import JsonOption, KeyArgument, RobotChoice, RobotOption, ThroughOption
from apps.cli.terminal import folded
from cocoro.bus.base import Payload
from cocoro.installed import topic_named

HINT_S = 3.0
"""After this time without a message a hint is printed."""


SHOWN = 12
"""Elements of a list that are shown by default."""
HEADER = ("stamp_ns", "seq", "incarnation")
"""Fields that every message has; `echo` shows them in the headline."""

app = typer.Typer()


@app.command()
def echo(
    key: KeyArgument,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, help="End after this number of messages.")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", min=0.1, metavar="S", help="End after this time.")] = None,
    full: Annotated[bool, typer.Option("--full", help="Print all elements of long lists.")] = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Messages of a key, decoded, of any type; one that a reader would reject is marked with the reason."""
    sys.exit(asyncio.run(print_messages(RobotChoice(robot, site), key, count, seconds, json, full)))


async def print_messages(
    choice: RobotChoice, text: str, count: int | None, seconds: float | None, as_json: bool, everything: bool
) -> int:
    """Prints until interrupted, `count` messages, or for `seconds`; returns the exit code: 1 when the time ended before
    the first message, or before `count` messages."""
    async with joined(choice, frames=takes_frames(text)) as link:
        listener = KeyListener(link, keyexpr_of(text, link.robot))
        with interrupt_event() as end:
            printed = await _print(listener, link.robot, end, count, seconds, as_json, everything)
            interrupted = end.is_set()
        if listener.dropped:
            print(f"cocoro: {listener.dropped} messages arrived too fast and were not printed", file=sys.stderr)
    enough = printed >= (count or 1)
    return exits.DONE if interrupted or enough else exits.FAILED


async def _print(
    listener: KeyListener,
    robot: str,
    end: asyncio.Event,
    count: int | None,
    seconds: float | None,
    as_json: bool,
    everything: bool,
) -> int:
    """Prints messages and returns their number."""
    printed, hinted = 0, False
    started_s = time.monotonic()
    while not end.is_set() and (count is None or printed < count):
        left_s = None if seconds is None else started_s + seconds - time.monotonic()
        if left_s is not None and left_s <= 0:
            break
        wait_s = left_s if hinted or printed else min(HINT_S, left_s or HINT_S)
        if not await listener.wait(end, wait_s):
            if not (printed or hinted or end.is_set()) and (left_s is None or left_s > HINT_S):
                hinted = True
                print(nothing_on(listener.keyexpr), file=sys.stderr)
            continue
        for received in listener.take()[: None if count is None else count - printed]:
            decoded = read(received.payload, received.key.removeprefix(f"{robot}/"))
            print(
                _as_json(received, decoded) if as_json else _fitted(_as_text(received, decoded, everything)), flush=True
            )
            printed += 1
    return printed


def _as_json(received: ReceivedPayload, decoded: DecodedPayload) -> str:
    entry = {"key": received.key, "type": decoded.type or None, "message": jsonable(decoded.value)}
    return json_module.dumps(entry | ({"problem": decoded.problem} if decoded.problem else {}))


def _fitted(text: str) -> str:
    """The lines of a text, each folded to the terminal's width two columns to the right of its beginning."""
    found = []
    for line in text.splitlines():
        words = line.lstrip()
        shift = " " * (len(line) - len(words))
        first, *rest = folded(f"{shift}  ", words)
        found += [shift + first.lstrip(), *rest]
    return "\n".join(found)


def _as_text(received: ReceivedPayload, decoded: DecodedPayload, everything: bool) -> str:
    value = decoded.value
    header: dict[Any, Any] = value if isinstance(value, dict) else {}
    title = [received.key, decoded.type or "(unknown type)"]
    if isinstance(seq := header.get("seq"), int):
        title.append(f"#{seq}")
    if isinstance(stamp_ns := header.get("stamp_ns"), int):
        title.append(f"{stamp_ns / 1e9:.3f} s")
    problems = [f"! {decoded.problem}"] if decoded.problem else []
    if isinstance(value, dict):
        rest = {key: item for key, item in value.items() if key not in HEADER}
        return "\n".join(["  ".join(title), *problems, *lines(rest, everything)])
    return "\n".join(["  ".join(title), *problems, *([] if value is None else lines(value, everything))])


# --- payloads of any type ---------------------------------------------------------------------------


class DecodedPayload(NamedTuple):
    type: str
    """The name of the topic's type; empty for a key that the table of topics does not have."""
    value: Any
    """Maps, lists, texts, numbers, bytes; None when the payload is not MessagePack."""
    problem: str
    """Why a reader of the topic rejects it; empty when it accepts it."""


def read(payload: Payload, topic_name: str) -> DecodedPayload:
    """Decode a payload without knowing its type; where the table of topics does, check it too. Never raises."""
    topic = topic_named(topic_name)
    name = topic.type.__name__ if topic is not None else ""
    try:
        value = msgpack.unpackb(payload, strict_map_key=False, timestamp=3, unicode_errors="replace")
    except Exception as error:  # the library raises many types of errors
        start = bytes(payload[:16]).hex(" ")
        return DecodedPayload(
            name, None, f"not MessagePack ({error or type(error).__name__}): {len(payload)} bytes, {start}"
        )
    if topic is None:
        return DecodedPayload("", value, "")
    if len(payload) > topic.max_bytes:
        return DecodedPayload(name, value, f"{len(payload)} bytes, at most {topic.max_bytes} are taken")
    try:
        msgspec.msgpack.decode(payload, type=topic.type)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
        return DecodedPayload(name, value, f"no good {name}: {error}")
    return DecodedPayload(name, value, "")


def jsonable(value: Any) -> Any:
    """The value with everything that JSON lacks as text: bytes by their number, NaN and infinity by their names."""
    if isinstance(value, dict):
        return {key if isinstance(key, str) else _text(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    return _text(value)


def lines(value: Any, everything: bool = False, indent: int = 2) -> Iterator[str]:
    """Renders a value, one line for each field; long lists are cut unless `everything` is set."""
    shift = " " * indent
    if isinstance(value, dict):
        for key, item in value.items():
            if _is_block(item):
                yield f"{shift}{_text(key)}:"
                yield from lines(item, everything, indent + 2)
            else:
                yield f"{shift}{_text(key)}: {_inline(item, everything)}"
    elif isinstance(value, list) and _is_block(value):
        some = value if everything else value[:SHOWN]
        for item in some:
            first, *rest = list(lines(item, everything, 0)) or ["{}"]
            yield f"{shift}- {first}"
            yield from (f"{shift}  {line}" for line in rest)
        if len(some) < len(value):
            yield f"{shift}({len(value) - len(some)} more of {len(value)})"
    else:
        yield f"{shift}{_inline(value, everything)}"


def _is_block(value: Any) -> bool:
    """Whether a value needs lines of its own: a non-empty map, or a list that contains one."""
    if isinstance(value, list):
        return any(isinstance(item, dict) and item for item in value)
    return isinstance(value, dict) and bool(value)


def _inline(value: Any, everything: bool) -> str:
    if isinstance(value, list):
        some = value if everything else value[:SHOWN]
        texts = [_inline(item, everything) for item in some]
        if len(some) < len(value):
            texts.append(f"({len(value) - len(some)} more of {len(value)})")
        return f"[{', '.join(texts)}]"
    return _text(value)


def _text(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    if isinstance(value, str):
        return value if value and value.isprintable() and value == value.strip() else repr(value)
    return str(value)
