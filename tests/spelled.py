"""Tasks and actions by their names, as tests write them."""

from __future__ import annotations

from typing import Any

from cocoro.messages import Intent, TaskRequest
from cocoro.messages.actions import ACTIONS, Action, Idle


def asked(
    task: str, label: str = "", timeout_s: float | None = None, asker: str = "", instead: bool = False, **fields: Any
) -> TaskRequest:
    """A request as it travels; a label only where one is given."""
    wire = {"task": task, **({"label": label} if label else {}), **fields}
    return TaskRequest(task=wire, timeout_s=timeout_s, asker=asker, instead=instead)


def action(name: str, label: str = "", **fields: Any) -> Action:
    """An action of the project's own; it takes the label if it has one."""
    kind = ACTIONS.kind(name)
    return ACTIONS.read({"action": name, **({"label": label} if "label" in kind.__struct_fields__ else {}), **fields})


def idle() -> Intent:
    return Intent(action=Idle())
