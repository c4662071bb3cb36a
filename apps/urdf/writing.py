"""The files of a new robot: its description as TOML, a profile, and the page of what is missing."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Any

from apps.urdf.missing import Missing

PAGE = "WHAT-IS-MISSING.md"
_TABLES = {
    "base": "What is not of the URDF's wheels is assumed. Safety times and acceleration are the Calliope's.",
    "camera": "Assumed: a Kinect's lens and depth.",
    "head": "The joints that turn the camera.",
    "arm": "Guessed from the joints' order and names.",
    "reach": "Chosen by the arm's kinematics: where a level hand comes to the floor clear of the base.",
    "link": "From the URDF: places of its joints. A joint about another axis than z has two rows.",
    "network": "Assumed: one servo line.",
    "joint": "Limits, torque and speed from the URDF where it has them; lines and IDs are to be set.",
    "claw": "Assumed.",
    "hull": "Assumed: balls along the arm.",
    "pose": "Chosen by the arm's kinematics, or all joints at 0.",
    "solid": "From the URDF: shapes, and for each link that moves a box that has its mass and touches nothing.",
}


def description_text(data: dict[str, Any], source: str) -> str:
    """The description as TOML, with a comment before each kind of table."""
    lines = [f"# Made from {source} by `cocoro new robot`. What is assumed here, and what is missing: {PAGE}.", ""]
    lines.append(f"name = {_value(data['name'])}")
    for table, comment in _TABLES.items():
        if table not in data:
            continue
        lines += ["", f"# {comment}", *_table(table, data[table])]
    return "\n".join([*lines, ""])


def profile_text(name: str) -> str:
    """A profile that runs the robot in the simulator."""
    return f"""# The robot {name}, simulated, on this machine: cocoro up FILE
robot = {_value(name)}
description = {_value(f"{name}.toml")}
clock = "sim"
processes = ["capture", "sim", "perception", "planning", "executive", "cockpit"]

[service.sim]
scene = "paper"

[service.capture]
keep_gb = 5.0          # beyond it captures go, idle ones first
"""


def page_text(name: str, source: str, missing: Iterable[Missing]) -> str:
    """The page of what is missing: a table for each section."""
    lines = [
        f"# What is missing in {name}.toml",
        "",
        f"Made from {source}. The simulator runs as it is: `cocoro up {name}-sim.toml`. Before a real robot",
        "moves by it, put its own values in the places below; a line whose value is right can go.",
    ]
    section = ""
    for row in missing:
        if row.section != section:
            section = row.section
            lines += ["", f"## {section}", "", "| what | where | what stands there now | what happens so |"]
            lines.append("| --- | --- | --- | --- |")
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in row[1:]) + " |")
    return "\n".join([*lines, ""])


def _table(name: str, data: Any) -> Iterator[str]:
    if isinstance(data, list):
        for number, row in enumerate(data):
            yield from (["", f"[[{name}]]"] if number else [f"[[{name}]]"])
            yield from _fields(row)
        return
    inner = {key: value for key, value in data.items() if isinstance(value, dict) and name in ("network", "pose")}
    rows = {key: value for key, value in data.items() if (name, key) == ("base", "wheel")}
    if plain := {key: value for key, value in data.items() if key not in inner | rows}:
        yield f"[{name}]"
        yield from _fields(plain)
    for number, (key, value) in enumerate(inner.items()):
        yield from (["", f"[{name}.{_key(key)}]"] if number else [f"[{name}.{_key(key)}]"])
        yield from _fields(value)
    for key, several in rows.items():
        for row in several:
            yield from ["", f"[[{name}.{key}]]", *_fields(row)]


def _fields(row: dict[str, Any]) -> Iterator[str]:
    for key, value in row.items():
        if isinstance(value, list) and value and isinstance(value[0], (dict, list)):
            yield f"{_key(key)} = ["
            yield from (f"  {_value(item)}," for item in value)
            yield "]"
        else:
            yield f"{_key(key)} = {_value(value)}"


def _key(name: str) -> str:
    plain = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if plain else _value(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return (
            "{ " + ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items()) + " }" if value else "{}"
        )
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)
