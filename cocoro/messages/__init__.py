"""The typed messages of the mesh, one file per service. Units are SI; the field's name has them (`_m`, `_rad`, `_mps`).

A message is a MessagePack map on the wire and is validated when it is decoded. Positions are in the body frame unless
the field says otherwise: x forward, y left, z up, origin on the floor between the drive wheels. A reader ignores
unknown fields, so a field with a default may be added at any time.
"""

from __future__ import annotations

from cocoro.messages.capture import DisturbedFile, Recording
from cocoro.messages.common import (
    LARGEST,
    Count,
    Finite,
    FiniteNonNegative,
    FiniteQuaternion,
    FiniteVec2,
    FiniteVec3,
    LatchState,
    Message,
)
from cocoro.messages.executive import (
    CancelRequest,
    KnownObject,
    ObjectsReply,
    ObjectsRequest,
    Outcome,
    Phase,
    RefusalCode,
    ReportRequest,
    TaskReply,
    TaskRequest,
    TaskState,
)
from cocoro.messages.hardware import (
    BaseCommand,
    BaseState,
    Frame,
    RecoverReply,
    RecoverRequest,
    ServoCommand,
    ServoReply,
    ServoRequest,
    ServoState,
)
from cocoro.messages.node import (
    AboutFile,
    AboutReply,
    AboutRequest,
    ClockOffset,
    Exchange,
    Health,
    LoopHealth,
    StepRecord,
    TimeReply,
    TimeRequest,
    TopicHealth,
)
from cocoro.messages.perception import Detection, Detections, Obstacles
from cocoro.messages.planning import (
    HandSample,
    Intent,
    LearnedModel,
    ModelReply,
    ModelRequest,
    PlannerStatus,
    TargetEstimate,
    WheelTrial,
)
from cocoro.messages.sim import ClockTick, TrueObject, Truth
from cocoro.messages.stop import EstopReply, EstopRequest, Latch, ResetRequest

__all__ = [
    "LARGEST",
    "AboutFile",
    "AboutReply",
    "AboutRequest",
    "BaseCommand",
    "BaseState",
    "CancelRequest",
    "ClockOffset",
    "ClockTick",
    "Count",
    "Detection",
    "Detections",
    "DisturbedFile",
    "EstopReply",
    "EstopRequest",
    "Exchange",
    "Finite",
    "FiniteNonNegative",
    "FiniteQuaternion",
    "FiniteVec2",
    "FiniteVec3",
    "Frame",
    "HandSample",
    "Health",
    "Intent",
    "KnownObject",
    "Latch",
    "LatchState",
    "LearnedModel",
    "LoopHealth",
    "Message",
    "ModelReply",
    "ModelRequest",
    "ObjectsReply",
    "ObjectsRequest",
    "Obstacles",
    "Outcome",
    "Phase",
    "PlannerStatus",
    "Recording",
    "RecoverReply",
    "RecoverRequest",
    "RefusalCode",
    "ReportRequest",
    "ResetRequest",
    "ServoCommand",
    "ServoReply",
    "ServoRequest",
    "ServoState",
    "StepRecord",
    "TargetEstimate",
    "TaskReply",
    "TaskRequest",
    "TaskState",
    "TimeReply",
    "TimeRequest",
    "TopicHealth",
    "TrueObject",
    "Truth",
    "WheelTrial",
]  # fmt: skip
