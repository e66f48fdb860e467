"""Where messages go: the log, the network, the viewer. A sink never sees the mapper."""

from __future__ import annotations

from typing import Protocol

from facet_protocol.codec import Message
from facet_protocol.messages import Envelope


class Sink(Protocol):
    """Sees every message once, in order, with the bytes it travels as."""

    def write(self, envelope: Envelope, message: Message | None) -> None:
        """Take one message; None where only the bytes are known (a scan not decoded yet)."""
        ...

    def close(self) -> None:
        """Finish what is open; a second call does nothing."""
        ...


__all__ = ["Message", "Sink"]
