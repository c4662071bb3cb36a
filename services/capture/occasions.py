"""Detection of occasions that are worth recording whole: a task runs, the emergency stop changes, a fault appears, or
the robot moves. Pure: messages in, occasions out."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from math import inf
from typing import Any, Literal

import msgspec

from cocoro.bus.base import Payload
from cocoro.capture.folder import IDLE, MOTION, label_of
from cocoro.capture.occasion import Note, Occasion
from cocoro.clock import NS
from cocoro.keys import service_of
from cocoro.messages import BaseState, Health, Latch, TaskState
from cocoro.topics import ARM_STATE, BASE_STATE, HAND_STATE, HEALTH, LATCH, TASK

AFTER_S = 5.0
"""An occasion lasts for this time after its last cause."""
LOSS_S = 1.0
"""A service whose token is gone for this time is a fault. A robot's recorder ends sooner when the robot is stopped."""
SAME_S = 600.0
"""A fault that appeared within this time before is no new one, so that one that comes and goes does not keep the
recorder busy."""
STILL_MPS, STILL_RADPS = 0.01, 0.02
"""A slower base stands still, also when its encoders tremble."""
STILL_RAD, STILL_S = 0.06, 2.0
"""Joints whose angles stay within this of those of up to so long ago are at rest; claws that grip tremble by 0.03."""
KEPT_NOTES = 50
_NUMBER = re.compile(r"\d+(\.\d+)?")

OccasionNews = Literal["begin", "note", "end"]
Listener = Callable[[OccasionNews, Occasion], None]
"""Called when an occasion begins, changes or ends. Another one may begin before it ended, and takes its place."""


_Reading = tuple[msgspec.msgpack.Decoder[Any], Callable[[str, Any, int], None]]


class _Angles(msgspec.Struct, gc=False):
    """What is looked at of the state of servos; decoding the rest of 100 states a second takes three times as long."""

    position_rad: tuple[float, ...]


class Watch:
    """Notices occasions. `see` gets messages, `alive` tokens, `look` the time; times are log times in ns."""

    def __init__(self, robot: str, listener: Listener) -> None:
        self._listener = listener
        self._occasion: Occasion | None = None
        self._until_ns = -inf
        self._task_id = ""
        """The running task; '' for none."""
        self._ended_task = ""
        self._latch = ""
        self._faults: dict[str, int] = {}
        """When each fault was present last."""
        self._lost: dict[str, int] = {}
        """Services without a token, and since when."""
        self._rest = {topic.key(robot): _Rest() for topic in (ARM_STATE, HAND_STATE)}
        self._moved_ns = -inf
        self._bumped = False
        self._read: dict[str, _Reading | None] = {
            TASK.key(robot): (msgspec.msgpack.Decoder(TaskState), self._on_task),
            LATCH.key(robot): (msgspec.msgpack.Decoder(Latch), self._on_latch),
            BASE_STATE.key(robot): (msgspec.msgpack.Decoder(BaseState), self._on_base),
            **dict.fromkeys(self._rest, (msgspec.msgpack.Decoder(_Angles), self._on_servos)),
        }
        """How each key is read; None: not at all. Keys that are not here are entered when they are seen first."""
        self._health: _Reading = msgspec.msgpack.Decoder(Health), self._on_health
        self._health_ends = f"/{HEALTH.of('*').name.rpartition('/')[2]}"

    @property
    def occasion(self) -> Occasion | None:
        return self._occasion

    def see(self, key: str, payload: Payload, log_ns: int) -> None:
        if key not in self._read:
            self._read[key] = self._health if key.endswith(self._health_ends) else None
        read = self._read[key]
        if read is None:
            return
        decoder, take = read
        try:
            message = decoder.decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return
        take(key, message, log_ns)

    def alive(self, service: str, alive: bool, log_ns: int) -> None:
        if alive:
            self._lost.pop(service, None)
        else:
            self._lost.setdefault(service, log_ns)

    def look(self, log_ns: int) -> None:
        """Notice what is due by time. To be called about ten times a second."""
        for service, since_ns in list(self._lost.items()):
            if log_ns - since_ns >= LOSS_S * NS:
                del self._lost[service]
                self._fault(f"{service} is gone", log_ns)
                if service == TASK.service and self._task_id:
                    self._end_task(TaskState(task_id=self._task_id), log_ns)
        if self._task_id:
            self._until_ns = log_ns + AFTER_S * NS
        if self._occasion is not None and log_ns >= self._until_ns:
            self._finish(log_ns)

    def close(self, log_ns: int) -> None:
        """The recorder ends, and with it its file."""
        if self._occasion is not None:
            self._occasion.ended_ns = self._occasion.ended_ns or log_ns
            self._listener("note", self._occasion)

    # --- causes -----------------------------------------------------------------------------------

    def _on_task(self, _key: str, state: TaskState, log_ns: int) -> None:
        if self._task_id and (state.task_id != self._task_id or state.outcome is not None):
            heard = state.task_id == self._task_id  # else a new executive or task has come since
            self._end_task(state if heard else TaskState(task_id=self._task_id), log_ns)
        if state.outcome is not None:
            self._ended_task = state.task_id
        elif state.task_id not in ("", self._task_id, self._ended_task):
            self._task_id = state.task_id
            what = f"{state.task} {state.label}".strip()
            label = label_of(state.task, state.label)
            label = f"task-{label}" if label in (IDLE, MOTION) else label
            self._begin(Occasion(kind="task", what=what, label=label, began_ns=log_ns, task_id=state.task_id))

    def _end_task(self, state: TaskState, log_ns: int) -> None:
        self._task_id = ""
        if (occasion := self._occasion) is not None and occasion.task_id == state.task_id:
            occasion.outcome, occasion.reason = state.outcome or "", state.reason
            occasion.elapsed_s, occasion.ended_ns = state.elapsed_s, log_ns
            self._listener("note", occasion)
        self._until_ns = log_ns + AFTER_S * NS

    def _on_latch(self, _key: str, latch: Latch, log_ns: int) -> None:
        before, self._latch = self._latch, latch.state
        if latch.state == before or "latched" not in (before, latch.state) or not before:
            return
        by = f" by {latch.by}" if latch.by else ""
        self._cause("stop", f"emergency stop {latch.state}{by}", log_ns)

    def _on_health(self, _key: str, health: Health, log_ns: int) -> None:
        late = {topic.fault for topic in health.topics if not topic.unreadable}  # a few rejections are no event
        troubles = [f"{health.service}: {fault}" for fault in health.faults if fault not in late]
        if health.state == "degraded" and not troubles:
            troubles = [f"{health.service} is degraded: {health.text}"]
        for trouble in troubles:
            self._fault(trouble, log_ns)

    def _fault(self, text: str, log_ns: int) -> None:
        kind = _NUMBER.sub("#", text)  # a count in it does not make it another fault
        last_ns, self._faults[kind] = self._faults.get(kind, -inf), log_ns
        if log_ns - last_ns > SAME_S * NS:
            self._faults = {each: at_ns for each, at_ns in self._faults.items() if log_ns - at_ns <= SAME_S * NS}
            self._cause("fault", text, log_ns)

    def _on_base(self, _key: str, state: BaseState, log_ns: int) -> None:
        bumped = state.bump_left or state.bump_right or state.cliff or state.wheel_drop
        if abs(state.speed_mps) > STILL_MPS or abs(state.turn_rate_radps) > STILL_RADPS or bumped != self._bumped:
            self._move("the base", log_ns)
        self._bumped = bumped

    def _on_servos(self, key: str, state: _Angles, log_ns: int) -> None:
        if self._rest[key].left_by(state.position_rad, log_ns):
            self._move(f"the {service_of(key)}", log_ns)

    def _move(self, what: str, log_ns: int) -> None:
        still = log_ns - self._moved_ns > AFTER_S * NS
        self._moved_ns = log_ns
        if self._task_id:
            return  # that it moves then is no news
        if self._occasion is None or (still and self._occasion.kind != "task"):
            self._cause(MOTION, f"{what} moves", log_ns)
        self._until_ns = max(self._until_ns, log_ns + AFTER_S * NS)

    def _cause(self, kind: str, text: str, log_ns: int) -> None:
        note = Note(log_ns, text)
        if self._occasion is None:
            self._begin(Occasion(kind=kind, what=text, label=kind, began_ns=log_ns, notes=(note,)))
        else:
            self._occasion.notes = (*self._occasion.notes, note)[-KEPT_NOTES:]
            self._listener("note", self._occasion)
        self._until_ns = max(self._until_ns, log_ns + AFTER_S * NS)

    # --- occasions --------------------------------------------------------------------------------

    def _begin(self, occasion: Occasion) -> None:
        self._occasion = occasion
        self._until_ns = occasion.began_ns + AFTER_S * NS
        self._listener("begin", occasion)

    def _finish(self, log_ns: int) -> None:
        occasion, self._occasion = self._occasion, None
        assert occasion is not None
        occasion.ended_ns = occasion.ended_ns or log_ns
        self._listener("end", occasion)


class _Rest:
    """Angles of joints at rest."""

    def __init__(self) -> None:
        self._angles: tuple[float, ...] = ()
        self._taken_ns = 0

    def left_by(self, angles: tuple[float, ...], log_ns: int) -> bool:
        """Whether the joints have moved since the angles that are kept, of up to STILL_S ago."""
        known = len(angles) == len(self._angles)
        moved = known and _furthest(angles, self._angles) > STILL_RAD
        if moved or not known or log_ns - self._taken_ns > STILL_S * NS:
            self._angles, self._taken_ns = angles, log_ns
        return moved


def _furthest(one: Iterable[float], other: Iterable[float]) -> float:
    return max((abs(a - b) for a, b in zip(one, other, strict=True)), default=0.0)
