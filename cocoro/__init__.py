"""CoCoRo mesh: the API that components, applications and tests are written against.

Everything that a component's author needs can be imported from here; each name is loaded at its first use, so that
`import cocoro` costs nothing. What is not named here is internal to the project.

- A component: `Component` declares it, `Implementation` is what its module gives, `Node` is what its `run` gets. A
  `Participant` reads and calls without being a service; `call_all` returns an `Answer` per service.
- A pure core: `Core` with its `Schedule`; it gets `Sample`s and returns `Output`s; `Take` says how it reads a topic.
- Messages: `Topic` and `Request` declare what travels; `Message` is the base of every published message, `Qos` the
  quality of service of a key, `Bus` the interface to the mesh. `Latest` and `Stream` read a topic's `Inbox`, and a
  `Publisher` publishes on one topic.
- A task: `Task` and `Skills`, `Action` for the planner, `TaskFailedError` to end it as failed.
- Time: `Clock` and its kinds, `is_fresh` for ages, `every` for loops, `NS` nanoseconds per second; `run_virtual` runs a
  coroutine in virtual time.
- The robot: `Robot` is the description of its body, `Catalogue` of `ObjectSpec`s the objects that it knows, `History` a
  state over time, `Pose2` a pose on the floor.
- Safety: `ServiceLatch` keeps the emergency stop's latch of a service that moves something; `Contact` finds out what
  became of a service that is no longer heard.
- Errors: `CocoroError` and its kinds; a command prints their text without a traceback.

Parts with a module of their own: `cocoro.topics` (the project's topics and requests), `cocoro.messages` (their types),
`cocoro.testing` (components under test), `cocoro.capture` (the format of captures; `apps.captures.reader` reads them),
`cocoro.kinematics`, `cocoro.learning`, `cocoro.arrays` and `cocoro.units` (types).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cocoro.bus.base import Bus, Qos
    from cocoro.clock import NS, Clock, FollowedClock, RealClock, VirtualClock, is_fresh
    from cocoro.component import Component, Implementation
    from cocoro.contact import Contact
    from cocoro.core import Core, Output, Sample, Schedule, Take
    from cocoro.errors import CallTimeoutError, CocoroError, ConfigError, MeshError, RefusedError, RemoteError
    from cocoro.frames import Pose2
    from cocoro.history import History
    from cocoro.inbox import Inbox, Latest, Stream
    from cocoro.latch import ServiceLatch
    from cocoro.messages import Message
    from cocoro.messages.actions import Action
    from cocoro.node import Node
    from cocoro.objects import Catalogue, ObjectSpec
    from cocoro.participant import Answer, Participant
    from cocoro.publisher import Publisher
    from cocoro.robot import Robot
    from cocoro.stepper import every
    from cocoro.tasks import Skills, Task, TaskFailedError
    from cocoro.topics import Request, Topic
    from cocoro.vloop import run_virtual

__all__ = [
    "NS", "Action", "Answer", "Bus", "CallTimeoutError", "Catalogue", "Clock", "CocoroError", "Component",
    "ConfigError", "Contact", "Core", "FollowedClock", "History", "Implementation", "Inbox", "Latest", "MeshError",
    "Message", "Node", "ObjectSpec", "Output", "Participant", "Pose2", "Publisher", "Qos", "RealClock",
    "RefusedError", "RemoteError", "Request", "Robot", "Sample", "Schedule", "ServiceLatch", "Skills", "Stream",
    "Take", "Task", "TaskFailedError", "Topic", "VirtualClock", "every", "is_fresh", "run_virtual",
]  # fmt: skip

_MODULES = {
    "bus.base": ("Bus", "Qos"),
    "clock": ("Clock", "FollowedClock", "NS", "RealClock", "VirtualClock", "is_fresh"),
    "component": ("Component", "Implementation"),
    "contact": ("Contact",),
    "core": ("Core", "Output", "Sample", "Schedule", "Take"),
    "errors": ("CallTimeoutError", "CocoroError", "ConfigError", "MeshError", "RefusedError", "RemoteError"),
    "frames": ("Pose2",),
    "history": ("History",),
    "inbox": ("Inbox", "Latest", "Stream"),
    "latch": ("ServiceLatch",),
    "messages": ("Message",),
    "messages.actions": ("Action",),
    "tasks": ("Skills", "Task", "TaskFailedError"),
    "node": ("Node",),
    "objects": ("Catalogue", "ObjectSpec"),
    "participant": ("Answer", "Participant"),
    "publisher": ("Publisher",),
    "robot": ("Robot",),
    "stepper": ("every",),
    "topics": ("Request", "Topic"),
    "vloop": ("run_virtual",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names

    def __getattr__(name: str) -> object:
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
