"""Where messages go: the log, the network, the viewer. A sink never sees the mapper."""

from __future__ import annotations

from typing import Protocol

from facet_protocol.messages import Cut, Envelope, MapUpdate, Scan, Status, TilePoints

Message = Scan | MapUpdate | TilePoints | Status | Cut


class Sink(Protocol):
    """Sees every message once, in order, with the bytes it travels as."""

    def write(self, envelope: Envelope, message: Message) -> None:
        """Take one message; must not keep a reference to arrays it means to change."""
        ...

    def close(self) -> None:
        """Finish what is open; a second call does nothing."""
        ...


__all__ = ["Message", "Sink"]
