"""When checkpoints are made, and where: on a thread of their own, one at a time."""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from facet.checkpoint import Checkpoint
from facet.config import RecordSection
from facet.resume import save
from facet.status import Account

logger = logging.getLogger(__name__)

WAIT_S = 5.0  # for the log


class Keeper:
    """Saves what the mapper's thread holds out to it. A failure costs time at the next start, no
    more: it is said and counted."""

    def __init__(
        self,
        record: RecordSection,
        account: Account,
        is_logged: Callable[[float], bool],
        clock: Callable[[], float] = time.monotonic,
        system: Any = os,
    ) -> None:
        self._directory, self._every_s = record.directory, record.checkpoint_s
        self._account, self._is_logged = account, is_logged
        self._clock, self._system = clock, system
        self._last_s = clock()
        self._saving = threading.Lock()
        self._log: dict[str, Any] = {}  # what the newest was made from

    def is_due(self) -> bool:
        """Whether it is time for another, and the last is done."""
        is_time = self._every_s > 0 and self._clock() - self._last_s >= self._every_s
        return is_time and not self._saving.locked()

    def start(self, checkpoint: Checkpoint) -> None:
        """Save it in the background."""
        self._last_s = self._clock()
        if checkpoint.header["log"] != self._log:  # nothing came in: the one there is will do
            threading.Thread(
                target=self._save_quietly, args=(checkpoint,), name="checkpoint", daemon=True
            ).start()

    def save(self, checkpoint: Checkpoint) -> tuple[Path, int]:
        """Save it now, or as soon as its cut is in the log: where it is, and its bytes. Raises
        OSError."""
        started = self._clock()
        with self._saving:
            try:
                if not self._is_logged(WAIT_S):
                    raise OSError(errno.EIO, "the log is not being written")
                path, num_bytes = save(self._directory, checkpoint, self._system)
            except OSError as error:
                self._account.count("checkpoint_failed")
                logger.warning("no checkpoint: %s", error)
                raise
            self._log = checkpoint.header["log"]
        self._last_s = self._clock()
        self._account.count("checkpoints")
        self._account.gauge("checkpoint_write_ms", (self._last_s - started) * 1e3)
        self._account.gauge("checkpoint_bytes", num_bytes)
        return path, num_bytes

    def _save_quietly(self, checkpoint: Checkpoint) -> None:
        with suppress(OSError):
            self.save(checkpoint)
