"""Who may look and who may operate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

Role = Literal["viewer", "operator"]
Doing = Literal["look", "stop", "operate"]
"""What a visitor asks for; everybody who may look may stop."""

LOOPBACK = ("127.0.0.1", "::1")


class Visitor(NamedTuple):
    """One who is let in."""

    name: str
    role: Role


class Gate:
    """Lets in who is on this machine, as an operator."""

    def who(self, scope: Mapping[str, Any]) -> Visitor | None:
        """The visitor behind an ASGI scope; None for one who is not let in."""
        client = scope.get("client")
        return Visitor("operator", "operator") if client is not None and client[0] in LOOPBACK else None

    def allows(self, visitor: Visitor, doing: Doing) -> bool:
        """Whether a visitor may do that."""
        return visitor.role == "operator" or doing in ("look", "stop")
