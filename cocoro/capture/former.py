"""Former shapes of messages: how a capture of an earlier version is read.

A type that was renamed, or whose recorded messages today's type cannot decode, has a rule here. The rules apply
wherever a capture's messages are read as today's types: in re-execution, in exports and in replays.
"""

from __future__ import annotations

RENAMED = {"Clock": "ClockTick"}
"""Today's name of a type, by its name in recorded schemas."""


def todays_name(schema: str) -> str:
    """Today's name of the type of a recorded schema."""
    return RENAMED.get(schema, schema)
