"""Makes the observations of a policy: the rows that an export would make of the same messages (`cocoro.features`)."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from numpy.typing import NDArray

from cocoro.arrays import Float32Array
from cocoro.clock import NS
from cocoro.features import JOINT_STATES, PICTURES, STATE, PolicyFeatures, picture_of, rows_of
from cocoro.messages import BaseState, Frame, Message, ServoState
from cocoro.policy import Observation, PolicyError
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, BASE_STATE, FRAME, Topic

KEPT = 64
"""States of each topic that are kept: more than a second of them, for pictures that are late."""
EARLY = 0.25
"""An observation may be so much of a period earlier than the rate has it: pictures jitter."""


class Observed(NamedTuple):
    stamp_ns: int
    """Of the picture; without pictures, of the arm's state."""
    seq: int
    incarnation: int
    """Those of the same message."""
    content: Observation


class Observer:
    """Takes the messages that observations are made of, in any order. One run of a policy has one."""

    def __init__(self, robot: Robot, features: PolicyFeatures, state_wait_s: float) -> None:
        self._joints = tuple(robot.joints)
        self._aside = robot.drive.goes_aside
        self._features = features
        self._beat: Topic[Any] = FRAME if features.width is not None else ARM_STATE
        """Each of its messages may become an observation."""
        self._wait_ns = round(state_wait_s * NS)
        self._period_ns = NS / features.rate_hz
        self._states: dict[str, deque[Message]] = {
            topic.name: deque(maxlen=KEPT) for topic in (*JOINT_STATES, BASE_STATE)
        }
        self._ages_ns = {topic.name: topic.max_age_s * NS for topic in (*JOINT_STATES, BASE_STATE)}
        self._due_ns = 0.0
        self._next: Message | None = None
        """What becomes an observation when the states of its time have arrived."""
        self._late_ns = 0

    def take(self, topic: Topic[Any], message: Message, now_ns: int) -> Observed | None:
        """Take a message. Returns the observation that is complete with it; None when none is. Raises PolicyError when
        a picture has another size than the policy looks at."""
        if topic.name in self._states:
            states = self._states[topic.name]
            if states and message.stamp_ns < states[-1].stamp_ns:  # the clock began anew
                states.clear()
                self._next, self._due_ns = None, 0.0
            states.append(message)
        if topic.name == self._beat.name:
            self._consider(message, now_ns)
        return self._complete(now_ns)

    def _consider(self, message: Message, now_ns: int) -> None:
        if isinstance(message, Frame) and (reason := self._features.misfit(message.width, message.height)):
            raise PolicyError(reason)
        if message.stamp_ns < self._due_ns or now_ns - message.stamp_ns > self._beat.max_age_s * NS:
            return
        self._next, self._late_ns = message, now_ns + self._wait_ns

    def _complete(self, now_ns: int) -> Observed | None:
        beat = self._next
        if beat is None:
            return None
        whole = all(states and states[-1].stamp_ns >= beat.stamp_ns for states in self._states.values())
        if not whole and now_ns < self._late_ns:
            return None
        self._next = None
        state = self._state(beat.stamp_ns)
        if state is None:
            return None
        self._due_ns = beat.stamp_ns + (self._features.rows_between - EARLY) * self._period_ns
        content: dict[str, NDArray[Any]] = {STATE: state}
        if isinstance(beat, Frame):
            content[PICTURES] = picture_of(beat).copy()  # the frame's memory is used again
        return Observed(beat.stamp_ns, beat.seq, beat.incarnation, content)

    def _state(self, at_ns: int) -> Float32Array | None:
        """The state at a time, shape (values,); None while a part of it is not known, or too old."""
        angles: dict[str, float] = {}
        base: BaseState | None = None
        for name, states in self._states.items():
            held = next((state for state in reversed(states) if state.stamp_ns <= at_ns), None)
            if held is None or at_ns - held.stamp_ns > self._ages_ns[name]:
                return None
            if isinstance(held, ServoState):
                angles.update(zip(held.joints, held.position_rad, strict=True))
            elif isinstance(held, BaseState):
                base = held
        if base is None or not all(joint in angles for joint in self._joints):
            return None
        joints = [angles[joint] for joint in self._joints]
        aside = (base.aside_mps,) if self._aside else ()
        row: Float32Array = rows_of(joints, (base.speed_mps, *aside, base.turn_rate_radps))[0]
        return row
