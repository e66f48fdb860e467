"""What is wrong with a log: what it has lost, or that it cannot be read at all."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

MAX_NOTES = 100


class LogError(ValueError):
    """A log that cannot be read: which file, at which byte if any, and why."""

    def __init__(self, path: Path, offset: int | None, reason: str) -> None:
        where = f"{path}: byte {offset}" if offset is not None else str(path)
        super().__init__(f"{where}: {reason}")
        self.path, self.offset, self.reason = path, offset, reason


@dataclass(slots=True)
class Damage:
    """What a file has lost: empty when it is whole."""

    notes: list[str] = field(default_factory=list)
    lost_messages: int = 0  # as far as the file itself still says
    lost_bytes: int = 0
    is_doubtful: bool = False  # what was read may be wrong, and it cannot be told where

    @property
    def is_lossy(self) -> bool:
        """More than the file's end or its index is missing."""
        return bool(self.lost_messages or self.lost_bytes or self.is_doubtful)

    def add(self, offset: int, num_bytes: int, reason: str) -> None:
        self.lost_bytes += num_bytes
        if len(self.notes) < MAX_NOTES:
            self.notes.append(f"byte {offset}: {reason}")
        elif len(self.notes) == MAX_NOTES:
            self.notes.append(f"byte {offset}: and more")

    def doubt(self, offset: int, reason: str) -> None:
        """What was read may not be what was written."""
        self.add(offset, 0, reason)
        self.is_doubtful = True

    def __bool__(self) -> bool:
        return bool(self.notes)

    def __str__(self) -> str:
        return f"lost {self.lost_messages:,} messages that are known of, {self.lost_bytes:,} bytes"
