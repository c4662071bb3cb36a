"""Re-execution: runs a service's pure core on the inputs of each recorded step and compares its outputs with the
recorded ones.

A step whose inputs the capture lacks is counted as not executable, never as equal. The core continues without them,
and a later difference is reported with that caveat.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from apps.captures.compare import difference, known_to
from apps.captures.info import changed_since, missing_of
from apps.captures.recorded import FoundMessage, MessageId, Origin, RecordedStep, origins, steps_of, with_messages
from cocoro.capture.reader import Capture
from cocoro.capture.types import NotReadableError
from cocoro.clock import NS
from cocoro.core import Core, Output, Sample
from cocoro.messages import Message
from cocoro.publisher import encode

SETTLE_NS = NS
"""After a step whose inputs were left out, a core has its former state again within this time."""


class FirstDifference(msgspec.Struct, kw_only=True):
    step: int
    """Sequence number of the recorded step."""
    at_s: float
    """Seconds from the capture's start."""
    now_ns: int
    text: str
    after_missing: bool
    """An earlier step was not executable, which may be the cause."""


class ReexecutionResult(msgspec.Struct, kw_only=True):
    service: str
    steps: int = 0
    equal: int = 0
    """Steps whose outputs all equal the recorded ones."""
    differing: int = 0
    not_executable: int = 0
    left_out: int = 0
    """Steps whose large inputs were left out of the captures by intention, while nothing happened."""
    unsettled: int = 0
    """Steps that differ within a second after such steps."""
    begins_late: bool = False
    """The captures lack the beginning of the run, so the core begins without what it knew."""
    outputs: int = 0
    """Compared outputs."""
    reasons: dict[str, int] = {}
    """Reasons why steps were not executable, with counts."""
    first: FirstDifference | None = None
    tolerance: float = 0.0
    recorded_s: float = 0.0
    """Time from the first step to the last."""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    """CPU time of this process; below `wall_s` on a busy machine."""
    changed: tuple[str, ...] = ()
    """Changed types of the compared messages, in words. Outputs are compared by the fields of both types."""
    problems: tuple[str, ...] = ()
    """Unreadable parts of the captures."""

    @property
    def speed(self) -> float:
        """The speed of the execution, as a multiple of real time; 0 when nothing was executed."""
        return self.recorded_s / self.wall_s if self.wall_s else 0.0


def reexecute(
    captures: Sequence[Capture], service: str, tolerance: float = 0.0, compare: bool = True
) -> ReexecutionResult:
    """Execute a service again on a run's captures, given in order. Without `compare` only the speed is measured.

    Raises CaptureError when the captures lack the service's steps or configuration, or it has no pure core.
    """
    started, cpu_started = time.perf_counter(), time.process_time()
    with origins(captures, service) as made:
        steps = steps_of(captures, service)
        run = _Reexecution(service, made, captures, tolerance if compare else None)
        run.published = {name[0] for _, record in steps for name in record.produced}
        for step in with_messages(captures, steps):
            run.execute(step)
    result = run.result
    result.begins_late = steps[0][1].seq > 0
    result.recorded_s = (steps[-1][0] - steps[0][0]) / NS
    result.changed = tuple(run.changed)
    result.problems = tuple(problem for capture in captures for problem in capture.problems)
    result.wall_s, result.cpu_s = time.perf_counter() - started, time.process_time() - cpu_started
    return result


class _Reexecution:
    def __init__(
        self, service: str, made: Sequence[Origin], captures: Sequence[Capture], tolerance: float | None
    ) -> None:
        self.result = ReexecutionResult(service=service, tolerance=tolerance or 0.0)
        self._made = made
        self._tolerance = tolerance
        self._start_ns = captures[0].start_ns
        self._thinned = {
            key.removeprefix(f"{each.robot}/")
            for each in captures
            if each.left_out
            for key in missing_of(each).left_out
        }
        self.published: set[str] = set()
        """The topics of all recorded outputs."""
        self._settled_ns = 0
        self._incarnation: int | None = None
        self._starts = 0
        self._seq = -1
        self._core: Core | None = None
        self._latency_ns = 0
        self._inputs_missed = False
        self._noted: set[tuple[Path, int]] = set()
        self.changed: dict[str, None] = {}

    def execute(self, step: RecordedStep) -> None:
        record = step.record
        if record.incarnation != self._incarnation:
            self._begin(record.incarnation)
        if missed := record.seq - self._seq - 1:
            self._cannot("its record is missing", missed)
        self._seq = record.seq
        self.result.steps += 1
        core = self._core
        assert core is not None
        samples, missing = self._samples(core, step)
        try:
            outputs = core.step(samples, record.now_ns)
        except Exception as error:  # a failing core is a result, too
            outputs, failure = (), f"the core fails: {type(error).__name__}: {error}"
        else:
            failure = ""
        if missing and step.thinned and self._large_only(step):
            self.result.left_out += 1
            self._settled_ns = step.log_ns + SETTLE_NS
            return
        if missing:
            self._cannot(missing)
            return
        if self._tolerance is None:
            return
        reason, text = ("", failure) if failure else self._compare(step, outputs)
        if reason:
            self._cannot(reason, inputs=False)
        elif text and step.log_ns < self._settled_ns:
            self.result.unsettled += 1
        elif text:
            self._differs(step, text)
        else:
            self.result.equal += 1

    def _large_only(self, step: RecordedStep) -> bool:
        """Whether the step's missing inputs are of keys of which large messages were left out."""
        return all(name[0] in self._thinned for name in step.record.consumed if name not in step.messages)

    def _begin(self, incarnation: int) -> None:
        """The service was started: make a new core with the configuration of that start."""
        origin = self._made[min(self._starts, len(self._made) - 1)]
        self._core = origin.core()
        self._latency_ns = round(origin.latency_s * NS)
        self._starts += 1
        self._incarnation, self._seq = incarnation, -1
        self._inputs_missed = False

    def _samples(self, core: Core, step: RecordedStep) -> tuple[list[Sample], str]:
        """The core's inputs, and which of the recorded inputs is missing and why ('' when none is)."""
        topics = {topic.name: topic for topic in core.reads}
        samples, missing = [], ""
        for name in step.record.consumed:
            topic, found = topics.get(name[0]), step.messages.get(name)
            if topic is None:
                missing = f"it consumed {name[0]}, which the core does not read today"
            elif found is None:
                missing = f"the capture lacks an input of {name[0]}"
            else:
                self._note_change(found)
                try:
                    message = found.capture.read(found.record)
                    assert isinstance(message, Message)
                    samples.append(Sample(topic, message))
                except NotReadableError:
                    missing = f"an input of {name[0]} cannot be read as today's type"
        return samples, missing

    def _compare(self, step: RecordedStep, outputs: Sequence[Output]) -> tuple[str, str]:
        """Compare a step's outputs with the recorded ones: the reason for which they cannot be compared, and the first
        difference; each is '' when there is none."""
        produced = step.record.produced
        outputs = [output for output in outputs if not self._is_new(output)]
        given, now = [name[0] for name in produced], [output.topic.name for output in outputs]
        if given != now:
            return "", f"it produced {', '.join(given) or 'nothing'} and now produces {', '.join(now) or 'nothing'}"
        for name, output in zip(produced, outputs, strict=True):
            found = step.messages.get(name)
            if found is None and not output.topic.recorded:
                continue
            if found is None:
                return f"the capture lacks an output on {name[0]}", ""
            self._note_change(found)
            self.result.outputs += 1
            payload = self._encoded(name, output, step.record.now_ns)
            if payload == found.record.payload:
                continue
            try:
                text = self._difference(found, payload)
            except NotReadableError:
                return f"an output on {name[0]} cannot be read as today's type", ""
            if text:
                return "", f"{name[0]}: {text}"
        return "", ""

    def _is_new(self, output: Output) -> bool:
        """Whether an output is of a topic that the recorded version did not have. That is known of a topic with a rate
        of its own: a version that has it publishes it in every run."""
        topic = output.topic
        if topic.rate_hz is None or topic.name in self.published:
            return False
        self.changed[f"{topic.name} is new: not compared"] = None
        return True

    def _encoded(self, name: MessageId, output: Output, now_ns: int) -> bytes:
        """The payload as the node would have published it."""
        message = output.message
        if message.stamp_ns == 0:
            message.stamp_ns = now_ns + self._latency_ns
        _, message.incarnation, message.seq = name
        return encode(message)

    def _difference(self, found: FoundMessage, payload: bytes) -> str:
        """The first difference in the fields that both the recorded and today's type have."""
        recorded = found.capture.read(found.record)
        now = found.capture.read(found.record._replace(payload=memoryview(payload)))
        plain = [msgspec.to_builtins(message, builtin_types=(bytes, memoryview)) for message in (recorded, now)]
        schema = found.capture.schema(found.record.channel)
        if schema is not None:
            plain = [known_to(schema.data, message) for message in plain]
        unlike = difference(plain[0], plain[1], self._tolerance or 0.0)
        return "" if unlike is None else unlike.text

    def _note_change(self, found: FoundMessage) -> None:
        """Note whether the type of a message's key has changed."""
        key, channel = found.record.key, found.record.channel
        if (found.capture.path, channel) not in self._noted:
            self._noted.add((found.capture.path, channel))
            self.changed.update(dict.fromkeys(f"{key}: {text}" for text in changed_since(found.capture, channel)))

    def _cannot(self, reason: str, count: int = 1, inputs: bool = True) -> None:
        self._inputs_missed |= inputs
        self.result.not_executable += count
        self.result.reasons[reason] = self.result.reasons.get(reason, 0) + count
        if reason == "its record is missing":
            self.result.steps += count

    def _differs(self, step: RecordedStep, text: str) -> None:
        self.result.differing += 1
        if self.result.first is None:
            self.result.first = FirstDifference(
                step=step.record.seq,
                at_s=(step.log_ns - self._start_ns) / NS,
                now_ns=step.record.now_ns,
                text=text,
                after_missing=self._inputs_missed,
            )


def describe_result(result: ReexecutionResult) -> list[str]:
    """One line per fact."""
    within = f" within {result.tolerance:g}" if result.tolerance else ""
    compared = f"{result.service}: {result.steps} steps, {result.outputs} outputs compared{within}: "
    whole = result.equal == result.steps - result.left_out - result.unsettled
    verdict = "every one equal" if whole else f"{result.equal} steps equal"
    lines = [compared + verdict]
    if result.differing:
        lines.append(f"  {result.differing} steps differ")
    if result.first is not None:
        first = result.first
        doubt = " (after a step that could not be executed, which may be why)" if first.after_missing else ""
        lines.append(f"  first in step {first.step}, at {first.at_s:.3f} s: {first.text}{doubt}")
    if result.not_executable:
        lines.append(f"  {result.not_executable} steps not executable")
        lines += [f"    {count}: {reason}" for reason, count in _by_count(result.reasons)]
    if result.begins_late:
        lines.append("  the captures begin in the middle of the run; --run takes those before them, too")
    if result.left_out:
        lines.append(f"  {result.left_out} steps of the time in which nothing happened have no frames, as configured")
    if result.unsettled:
        lines.append(f"  {result.unsettled} steps differ within a second after these")
    lines += [f"  changed since, {change}" for change in result.changed]
    lines += [f"  not read: {problem}" for problem in result.problems]
    times = f"{result.wall_s:.1f} s ({result.cpu_s:.1f} s of CPU time)"
    lines.append(f"  {result.recorded_s:.1f} s in {times}: {result.speed:.1f} times real time")
    return lines


def _by_count(reasons: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(reasons.items(), key=lambda item: -item[1])
