"""A service's steps as they were recorded: what each consumed and gave, found in a capture in one pass."""

from __future__ import annotations

import base64
import hashlib
import json
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from apps.rehearsal.lockstep import LOCKSTEP_PLANNER
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import LossyFrame, MessageHead, NotReadableError
from cocoro.clock import NS
from cocoro.component import Implementation
from cocoro.component import load as load_component
from cocoro.core import Core
from cocoro.errors import ConfigError
from cocoro.messages import StepRecord
from cocoro.robot import Robot
from cocoro.topics import STEPS
from deploy import processes
from services.capture.recorder import KeyCounts, counts_of

MessageId = tuple[str, int, int]
"""Topic, incarnation, sequence: what a StepRecord calls a message by."""

LATE_NS = 3 * NS
"""A message that is recorded so long after the step that speaks of it is not waited for."""


class FoundMessage(NamedTuple):
    """A message of a step, with the capture that it is in."""

    capture: Capture
    record: Record


class RecordedStep(NamedTuple):
    record: StepRecord
    log_ns: int
    messages: dict[MessageId, FoundMessage]
    """What the captures have of those that were consumed and produced."""


def steps_of(captures: Sequence[Capture], service: str) -> list[tuple[int, StepRecord]]:
    """Log time and content of every record of a step. Raises CaptureError when there is none, or one cannot be read."""
    found = []
    for capture in captures:
        for record in capture.messages(f"{capture.robot}/{STEPS.of(service).name}"):
            try:
                step = capture.read(record)
            except NotReadableError as error:
                raise CaptureError(f"{capture.path}: {error}") from error
            assert isinstance(step, StepRecord)
            found.append((record.log_ns, step))
    if not found:
        raise CaptureError(
            f"{captures[0].path}: it has no steps of {service}; have them recorded by record_steps = true "
            f"in the profile's [service.{service}]"
        )
    return found


def with_messages(captures: Sequence[Capture], steps: Sequence[tuple[int, StepRecord]]) -> Iterator[RecordedStep]:
    """The steps in order, each as soon as all is there that it speaks of, or as soon as that will not come any more."""
    wanted: set[MessageId] = set()
    for _, step in steps:
        wanted.update(step.consumed, step.produced)
    topics = {topic for topic, _, _ in wanted}
    waiting = deque(steps)
    known: dict[MessageId, FoundMessage] = {}
    counts: dict[str, KeyCounts] = {}
    for capture in captures:
        decoder = msgspec.msgpack.Decoder(MessageHead)
        for record in capture.messages(*(f"{capture.robot}/{topic}" for topic in topics)) if topics else ():
            head = _head(decoder, record)
            if head is None:
                continue
            if record.key not in counts:
                counts[record.key] = counts_of(record.key, capture.robot)
            in_sequence = counts[record.key].hear(head)
            name = (record.key.removeprefix(f"{capture.robot}/"), head.incarnation, head.seq)
            # Of several messages with one number readers take the one that is in sequence, and so does this.
            if name in wanted and (in_sequence or name not in known) and not _lossy(capture, record):
                known[name] = FoundMessage(capture, record)
            while waiting and (_complete(waiting[0][1], known) or record.log_ns > waiting[0][0] + LATE_NS):
                yield _taken(waiting.popleft(), known, wanted)
    while waiting:
        yield _taken(waiting.popleft(), known, wanted)


def _head(decoder: msgspec.msgpack.Decoder[MessageHead], record: Record) -> MessageHead | None:
    try:
        return decoder.decode(record.payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def _complete(step: StepRecord, known: dict[MessageId, FoundMessage]) -> bool:
    return all(name in known for name in step.consumed) and all(name in known for name in step.produced)


def _taken(step: tuple[int, StepRecord], known: dict[MessageId, FoundMessage], wanted: set[MessageId]) -> RecordedStep:
    """Each message belongs to one step, so it need not be kept any more; nor is it when it comes late."""
    log_ns, record = step
    names = (*record.consumed, *record.produced)
    wanted.difference_update(names)
    messages = {name: known.pop(name) for name in names if name in known}
    return RecordedStep(record, log_ns, messages)


def _lossy(capture: Capture, record: Record) -> bool:
    """A frame that was kept with loss is not what the step was given."""
    schema = capture.schema(record.channel)
    return schema is not None and schema.name == LossyFrame.__name__


T = TypeVar("T")


@dataclass(frozen=True)
class Origin:
    """One start of a service."""

    service: str
    implementation: Implementation[Any]
    robot: Robot
    config: Any
    latency_s: float

    def core(self) -> Core:
        """A new core, as it was at the start."""
        assert self.implementation.core is not None
        return self.implementation.core(self.robot, self.config)


@contextmanager
def origins(captures: Sequence[Capture], service: str) -> Iterator[list[Origin]]:
    """Every start of a service that the captures tell of, in order. Within the context its files are there.

    Raises CaptureError when there is none, or when its core cannot be made here.
    """
    told = [entries for capture in captures for entries in capture.every_metadata(f"service/{service}")]
    starts = [entries for n, entries in enumerate(told) if entries not in told[:n]]
    path = captures[0].path
    if not starts:
        there = sorted({name[8:] for capture in captures for name in capture.metadata if name.startswith("service/")})
        raise CaptureError(
            f"{path}: it does not say what {service} was started with; it does of {', '.join(there) or 'none'}"
        )
    with tempfile.TemporaryDirectory(prefix="cocoro-") as folder:
        try:
            made = [_origin(service, entries, Path(folder) / str(n)) for n, entries in enumerate(starts)]
        except (KeyError, TypeError, ValueError, ConfigError) as error:
            raise CaptureError(f"{path}: what {service} was started with cannot be had again: {error}") from error
        yield made


def recorded_file(capture: Capture, service: str, field: str, load: Callable[[Path | None], T]) -> T:
    """What a loader makes of a file that a service was configured with, as it was then (None: not told)."""
    told = json.loads(capture.metadata.get(f"service/{service}", {}).get("files", "[]"))
    content = next((base64.b64decode(file["content"]) for file in told if file["field"] == field), b"")
    if not content:
        return load(None)
    with tempfile.NamedTemporaryFile(suffix=".toml") as copy:
        copy.write(content)
        copy.flush()
        return load(Path(copy.name))


def _origin(service: str, entries: Mapping[str, str], folder: Path) -> Origin:
    module = entries["module"]
    settings = json.loads(entries["config"])
    # Until 2026 the planner had the setting `coordination`; lock-step is a component of its own now.
    if settings.pop("coordination", "concurrent") == "lockstep":
        module = LOCKSTEP_PLANNER.module
    component = LOCKSTEP_PLANNER if module == LOCKSTEP_PLANNER.module else processes.by_module(module)
    if component is None:
        raise ConfigError(f"no component that is installed here has the module {module!r}")
    implementation = load_component(component)
    if implementation.core is None:
        raise CaptureError(f"{service} cannot be executed again: {module} has no pure core")
    for file in json.loads(entries["files"]):
        settings[file["field"]] = _same_file(file, folder, settings.get(file["field"]))
    try:
        config = msgspec.convert(settings, implementation.config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"it was configured for another version: {error}") from error
    robot = Robot.from_data(json.loads(entries["description"]), "the recorded robot description")
    return Origin(service, implementation, robot, config, float(entries["latency_s"]))


def _same_file(file: Mapping[str, str], folder: Path, configured: str | None) -> str | None:
    """What to configure so that the file is the one of then: what was, if that is still it, else the recorded copy."""
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
        raise ConfigError(f"it needs the file {file['path']} of sha256 {file['sha256']}, which is not here")
    folder.mkdir(exist_ok=True)
    copy = folder / Path(file["path"]).name
    copy.write_bytes(content)
    return str(copy)
