"""A node's knowledge of services whose liveliness token dropped."""

from __future__ import annotations


class Contact:
    """Knows nothing of the processes behind the services; `deploy.contact.ProcessContact` knows this machine's."""

    keeps = False
    """Whether `keep` has work to do."""

    async def keep(self) -> None:
        """Work that must run in the event loop of the node, for ever."""

    def met(self, service: str) -> None:
        """A service's token appeared."""

    def dead(self, service: str) -> bool:
        """Whether the process that was this service is known to have ended."""
        return False

    def lives(self, service: str) -> bool:
        """Whether the process that was this service is known to live, so that only the contact with it is lost."""
        return False

    def starting(self, service: str) -> bool:
        """Whether a successor of the dead process that was this service is known to be starting."""
        return False

    async def lost(self, service: str) -> str:
        """A service's token dropped. Returns what is known of it, in words."""
        return f"lost contact with {service}"
