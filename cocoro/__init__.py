"""CoCoRo mesh: the API that components, applications and tests are written against.

Everything that a component's author needs can be imported from here. `import cocoro` itself loads nothing; the first
use of a name loads the whole API, so the declaration of a component, which every command imports, takes its names from
their modules, such as `cocoro.component`. Names that are not listed here are internal to the project.

- A component: `Component` declares it, `Implementation` is what its module gives, `Node` is what its `run` gets. A
  `Participant` reads and calls without being a service; `call_all` returns an `Answer` per service.
- A pure core: `Core` with its `Schedule`; it gets `Sample`s and returns `Output`s; `Take` says how it reads a topic.
- Messages: `Topic` and `Request` declare what travels; `Message` is the base of every published message, `Qos` the
  quality of service of a key, `Bus` the interface to the mesh. `Latest` and `Stream` read a topic's `Inbox`, and a
  `Publisher` publishes on one topic.
- A client: `connect` and `connect_blocking` operate a robot from a program, `rehearse` tries the program on a
  simulated one in virtual time, `open` reads a capture as arrays (docs/client.md). They are lent to this package by the
  applications, and `from cocoro import *` leaves them out. A task that a robot refuses is a `TaskRefusedError` of its
  own kind, one that is not done a `TaskEndedError`; `Motion` drives by hand.
- A task: `Task` and `Skills`, `Action` for the planner, `TaskFailedError` to end it as failed.
- Time: `Clock` and its kinds, `is_fresh` for ages, `every` for loops, `NS` nanoseconds per second; `run_virtual` runs a
  coroutine in virtual time.
- The robot: `Robot` is the description of its body, `Catalogue` of `ObjectSpec`s the objects that it knows, `History` a
  state over time, `Pose2` a pose on the floor.
- Safety: `ServiceLatch` keeps the emergency stop's latch of a service that moves something; `Contact` finds out what
  became of a service whose liveliness token dropped.
- Errors: `CocoroError` and its kinds; a command prints their text without a traceback.

Parts with a module of their own: `cocoro.topics` (the project's topics and requests), `cocoro.messages` (their types),
`cocoro.testing` (components under test), `cocoro.capture` (the format of captures; `cocoro.capture.reader` reads them),
`cocoro.kinematics`, `cocoro.learning`, `cocoro.arrays` and `cocoro.units` (types).
"""

from __future__ import annotations

__all__ = [
    "NS", "Action", "Answer", "AskerGoneError", "BadRequestError", "BatteryLowError", "Bus", "BusyError",
    "CallTimeoutError", "Catalogue", "Clock", "CocoroError", "Component", "ConfigError", "Contact", "Core",
    "FollowedClock", "History", "HoldingError", "Implementation", "Inbox", "Latest", "MeshError", "Message", "Motion",
    "NoTaskError", "Node", "NotAbleError", "NotAliveError", "NotGraspableError", "NotHoldingError", "ObjectSpec",
    "Output", "Participant", "Pose2", "Publisher", "Qos", "RealClock", "RefusedError", "RemoteError", "Request",
    "Robot", "Sample", "Schedule", "ServiceLatch", "Skills", "StoppedError", "Stream", "Take", "Task",
    "TaskCancelledError", "TaskEndedError", "TaskFailedError", "TaskLostError", "TaskRefusedError", "Topic",
    "UnknownLabelError", "VirtualClock", "every", "is_fresh", "run_virtual",
]  # fmt: skip

_LENT = {
    "connect": "apps.client.connecting",
    "connect_blocking": "apps.client.blocking",
    "open": "apps.client.opening",
    "rehearse": "apps.client.rehearsing",
}
"""Names of applications that a user finds here, by module. They are imported by name when they are used first: nothing
of this package imports what stands above it. Type checkers see all names in `__init__.pyi`."""


def __getattr__(name: str) -> object:
    if name in _LENT:
        from cocoro.entry_points import lent

        return lent(_LENT[name], name)
    if name not in __all__:  # the name of a module, or an unknown one
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from cocoro import api

    globals().update({public: getattr(api, public) for public in __all__})
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_LENT})
