"""Bare zenoh sessions for tests."""

from __future__ import annotations

import json
from typing import Any

import zenoh

LOCAL = "unixsock-stream"
"""Protocol of endpoints that are files."""


def opened(mode: str, listen: list[str], connect: list[str], more: dict[str, Any]) -> zenoh.Session:
    options = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": 2000 if mode == "client" else -1,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
        **more,
    }
    config = zenoh.Config()
    for path, value in options.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)
