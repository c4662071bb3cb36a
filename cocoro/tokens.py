"""Where the liveliness tokens of a robot's services are."""

from __future__ import annotations


def alive_key(robot: str, service: str) -> str:
    """The token of a service that works, from ready to its end; `service='*'` is that of all."""
    return f"{robot}/{service}/alive"


def recorder_key(robot: str, service: str) -> str:
    """The token of a service that records the mesh, declared once it hears everything."""
    return f"{robot}/{service}/recorder"
