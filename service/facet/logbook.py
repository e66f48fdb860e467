"""The lines of log on standard error. A thread of its own writes them: the threads of a service
never wait for who reads them, not for a pipe that nobody reads either."""

from __future__ import annotations

import logging
import os
import queue
import threading

MAX_WAITING = 1000  # lines that wait for their reader; what comes then is dropped and counted
PATIENCE_S = 1.0  # at the end, for what still waits
LINE = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class Logbook(logging.Handler):
    """Drops and counts where other handlers would block."""

    def __init__(self, descriptor: int = 2) -> None:
        """`descriptor` is of a file open for writing; it is not closed. Not of sys.stderr's buffer:
        a thread that hangs in that one lets no interpreter end."""
        super().__init__()
        self.num_dropped = 0
        self._descriptor = descriptor
        self._waiting: queue.Queue[str | None] = queue.Queue(MAX_WAITING)
        self._writer = threading.Thread(target=self._write, name="log", daemon=True)
        self._writer.start()

    def emit(self, record: logging.LogRecord) -> None:
        """To the writer, or to the count of what was dropped."""
        try:
            self._waiting.put_nowait(self.format(record))
        except queue.Full:
            self.num_dropped += 1

    def close(self) -> None:
        """Write what waits, at most for PATIENCE_S; a writer that hangs ends with the process."""
        try:
            self._waiting.put(None, timeout=PATIENCE_S)
            self._writer.join(PATIENCE_S)
        except queue.Full:
            pass
        super().close()

    def _write(self) -> None:
        told = 0
        while (line := self._waiting.get()) is not None:
            if (num := self.num_dropped) > told:
                line += f"\n({num - told} lines of log were dropped: nobody read them)"
                told = num
            left = f"{line}\n".encode(errors="backslashreplace")
            try:
                while left:
                    left = left[os.write(self._descriptor, left) :]
            except OSError:  # who read it has gone
                self.num_dropped += 1


def keep_log() -> Logbook:
    """One line a message on standard error, from here on."""
    book = Logbook()
    logging.basicConfig(level=logging.INFO, format=LINE, handlers=[book], force=True)
    return book
