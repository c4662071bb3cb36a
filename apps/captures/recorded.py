"""A service's recorded starts and steps: its configurations, and what each step consumed and produced."""

from __future__ import annotations

import base64
import hashlib
import json
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from apps.rehearsal.lockstep import LOCKSTEP_PLANNER, PLANNING_MODULE
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import LossyFrame, MessageHead, NotReadableError
from cocoro.clock import NS
from cocoro.component import Implementation
from cocoro.component import load as load_component
from cocoro.core import Core
from cocoro.errors import ConfigError, field_text
from cocoro.messages import StepRecord
from cocoro.robot import Robot
from cocoro.topics import STEPS
from deploy import processes
from services.capture.recorder import KeyCounts, counts_of

MessageId = tuple[str, int, int]
"""Topic, incarnation, sequence number: a StepRecord's reference to a message."""

LATE_NS = 3 * NS
"""A step waits for its messages only up to this log time after its own."""


class FoundMessage(NamedTuple):
    """A message of a step, and the capture that contains it."""

    capture: Capture
    record: Record


class RecordedStep(NamedTuple):
    record: StepRecord
    log_ns: int
    messages: dict[MessageId, FoundMessage]
    """The consumed and produced messages that the captures contain."""
    thinned: bool = False
    """It was recorded while large messages were left out by intention."""


def steps_of(captures: Sequence[Capture], service: str) -> list[tuple[int, StepRecord]]:
    """Log time and content of every recorded step. Raises CaptureError when there is none, or one cannot be read."""
    found = []
    once = Once()
    for capture in captures:
        for record in once.each(capture.messages(f"{capture.robot}/{STEPS.of(service).name}")):
            try:
                step = capture.read(record)
            except NotReadableError as error:
                raise CaptureError(f"{capture.path}: {error}") from error
            assert isinstance(step, StepRecord)
            found.append((record.log_ns, step))
    if not found:
        raise CaptureError(
            f"{captures[0].path}: it has no steps of {service}; set record_steps = true "
            f"in the profile's [service.{service}] to record them"
        )
    return found


class Once:
    """Leaves out messages of a run that an earlier one of its captures had already: a file that begins with a task
    repeats those of the seconds before."""

    def __init__(self) -> None:
        self._newest_ns: dict[str, int] = {}

    def each(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records of the next capture."""
        before = dict(self._newest_ns)
        for record in records:
            if record.log_ns > before.get(record.key, -1):
                self._newest_ns[record.key] = max(record.log_ns, self._newest_ns.get(record.key, 0))
                yield record


def with_messages(captures: Sequence[Capture], steps: Sequence[tuple[int, StepRecord]]) -> Iterator[RecordedStep]:
    """The steps in order, found in one pass. Each comes when all its messages are found, or when the missing ones can
    no longer come."""
    wanted: set[MessageId] = set()
    for _, step in steps:
        wanted.update(step.consumed, step.produced)
    topics = {topic for topic, _, _ in wanted}
    waiting = deque(steps)
    known: dict[MessageId, FoundMessage] = {}
    counts: dict[str, KeyCounts] = {}
    once = Once()
    thinned = [stretch for capture in captures for stretch in capture.left_out]
    for capture in captures:
        decoder = msgspec.msgpack.Decoder(MessageHead)
        keys = [f"{capture.robot}/{topic}" for topic in topics]
        for record in once.each(capture.messages(*keys)) if topics else ():
            head = _head(decoder, record)
            if head is None:
                continue
            if record.key not in counts:
                counts[record.key] = counts_of(record.key, capture.robot)
            in_sequence = counts[record.key].count(head)
            name = (record.key.removeprefix(f"{capture.robot}/"), head.incarnation, head.seq)
            # Several messages may claim one number. Readers take the one that is in sequence, and so does this.
            if name in wanted and (in_sequence or name not in known) and not _lossy(capture, record):
                known[name] = FoundMessage(capture, record)
            while waiting and (_complete(waiting[0][1], known) or record.log_ns > waiting[0][0] + LATE_NS):
                yield _taken(waiting.popleft(), known, wanted, thinned)
    while waiting:
        yield _taken(waiting.popleft(), known, wanted, thinned)


def _head(decoder: msgspec.msgpack.Decoder[MessageHead], record: Record) -> MessageHead | None:
    try:
        return decoder.decode(record.payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def _complete(step: StepRecord, known: dict[MessageId, FoundMessage]) -> bool:
    return all(name in known for name in step.consumed) and all(name in known for name in step.produced)


def _taken(
    step: tuple[int, StepRecord],
    known: dict[MessageId, FoundMessage],
    wanted: set[MessageId],
    thinned: Sequence[tuple[int, int]],
) -> RecordedStep:
    """Remove a step's messages from `known` and `wanted`: each message belongs to one step."""
    log_ns, record = step
    names = (*record.consumed, *record.produced)
    wanted.difference_update(names)
    messages = {name: known.pop(name) for name in names if name in known}
    left_out = any(start <= log_ns < end + LATE_NS for start, end in thinned)
    return RecordedStep(record, log_ns, messages, left_out)


def _lossy(capture: Capture, record: Record) -> bool:
    """A lossy frame is not what the step consumed."""
    schema = capture.schema(record.channel)
    return schema is not None and schema.name == LossyFrame.__name__


@dataclass(frozen=True)
class Origin:
    """One start of a service."""

    service: str
    implementation: Implementation[Any]
    robot: Robot
    config: Any
    latency_s: float

    def core(self) -> Core:
        """A new core in its initial state."""
        assert self.implementation.core is not None
        return self.implementation.core(self.robot, self.config)


@contextmanager
def origins(captures: Sequence[Capture], service: str) -> Iterator[list[Origin]]:
    """Every recorded start of a service, in order. The files of its configuration exist while the context lasts.

    Raises CaptureError when no start is recorded, or its core cannot be made today.
    """
    recorded = [entries for capture in captures for entries in capture.every_metadata(f"service/{service}")]
    starts = [entries for n, entries in enumerate(recorded) if entries not in recorded[:n]]
    path = captures[0].path
    if not starts:
        there = sorted({name[8:] for capture in captures for name in capture.metadata if name.startswith("service/")})
        raise CaptureError(
            f"{path}: it has no configuration of {service}; services with one: {', '.join(there) or 'none'}"
        )
    with tempfile.TemporaryDirectory(prefix="cocoro-") as folder:
        try:
            made = [_origin(service, entries, Path(folder) / str(n)) for n, entries in enumerate(starts)]
        except (KeyError, TypeError, ValueError, ConfigError) as error:
            raise CaptureError(f"{path}: the start of {service} cannot be repeated: {error}") from error
        yield made


def _origin(service: str, entries: Mapping[str, str], folder: Path) -> Origin:
    module = entries["module"]
    settings = json.loads(entries["config"])
    if module == PLANNING_MODULE and settings.pop("coordination", "concurrent") == "lockstep":
        module = LOCKSTEP_PLANNER.module  # a former setting of the planner; now a component of its own
    component = LOCKSTEP_PLANNER if module == LOCKSTEP_PLANNER.module else processes.by_module(module)
    if component is None:
        raise ConfigError(f"no component that is installed here has the module {module!r}")
    implementation = load_component(component)
    if implementation.core is None:
        raise CaptureError(f"{service} cannot be re-executed: {module} has no pure core")
    for file in json.loads(entries["files"]):
        settings[file["field"]] = _same_file(file, folder, settings.get(file["field"]))
    try:
        config = msgspec.convert(settings, implementation.config)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"its configuration does not fit today's component: {field_text(error, implementation.config)}"
        ) from error
    robot = Robot.from_data(json.loads(entries["description"]), "the recorded robot description")
    return Origin(service, implementation, robot, config, float(entries["latency_s"]))


def _same_file(file: Mapping[str, str], folder: Path, configured: str | None) -> str | None:
    """The configured path, when the file there is still the recorded one; otherwise a copy of the recorded file. Raises
    ConfigError when there is neither."""
    content = base64.b64decode(file["content"])
    try:
        if configured is not None:
            today = Path(configured).read_bytes()
        else:
            today = resources.files("cocoro").joinpath(file["path"]).read_bytes()
    except OSError:
        today = b""
    if hashlib.sha256(today).hexdigest() == file["sha256"]:
        return configured
    if not content:
        raise ConfigError(
            f"the file {file['path']} with sha256 {file['sha256']} is missing, and the capture has no copy"
        )
    folder.mkdir(exist_ok=True)
    copy = folder / Path(file["path"]).name
    copy.write_bytes(content)
    return str(copy)
