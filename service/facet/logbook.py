"""The lines of log on standard error. A thread of its own writes them: the threads of a service
never wait for who reads them, not for a pipe that nobody reads either."""

from __future__ import annotations

import logging
import os
import queue
import sys
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
        self._descriptor = descriptor
        self._num_refused = self._num_lost = 0  # each counted by one thread at a time
        self._waiting: queue.Queue[str | None] = queue.Queue(MAX_WAITING)
        self._writer = threading.Thread(target=self._write_all, name="log", daemon=True)
        self._writer.start()

    @property
    def num_dropped(self) -> int:
        """Lines that came while too many waited, and those that could not be written."""
        return self._num_refused + self._num_lost

    def emit(self, record: logging.LogRecord) -> None:
        """To the writer, or to the count of what was dropped."""
        try:
            line = self.format(record)
        except Exception as error:  # noqa: BLE001 whoever logs does not end by it
            line = f"{record.name}: {record.msg!r} cannot be formatted: {error}"
        self.say(line)

    def say(self, line: str) -> None:
        """A line as it is."""
        try:
            self._waiting.put_nowait(line)
        except queue.Full:
            self._num_refused += 1

    def close(self) -> None:
        """Write what waits, at most for PATIENCE_S; a writer that hangs ends with the process."""
        try:
            self._waiting.put(None, timeout=PATIENCE_S)
            self._writer.join(PATIENCE_S)
        except queue.Full:
            pass
        super().close()

    def _write_all(self) -> None:
        told, start = 0, ""
        while (line := self._waiting.get()) is not None:
            if (num := self.num_dropped) > told:
                line += f"\n({num - told} lines of log were dropped: nobody took them)"
            left = whole = f"{start}{line}\n".encode(errors="backslashreplace")
            try:
                while left:
                    left = left[os.write(self._descriptor, left) :]
                told, start = num, ""
            except OSError:  # who read it has gone
                self._num_lost += 1
                start = "\n" if len(left) < len(whole) else start  # a part of it is there


def keep_log() -> Logbook:
    """One line a message on standard error, from here on; nowhere, where that is closed: another
    file may have its number."""
    book = Logbook(2 if sys.stderr is not None else os.open(os.devnull, os.O_WRONLY))
    logging.basicConfig(level=logging.INFO, format=LINE, handlers=[book], force=True)
    return book
