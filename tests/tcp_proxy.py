"""A network that can fail: a proxy on loopback between a robot and the service."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from types import TracebackType


class Proxy:
    """Forwards 127.0.0.1:`port` to `target`. `cut` drops every connection and takes no new one."""

    num_bytes = 0  # that went to the target

    def __init__(self, target: str) -> None:
        host, _, port = target.removeprefix("tcp/").rpartition(":")
        self._target = (host, int(port))
        self._pairs: list[socket.socket] = []
        self._lock = threading.Lock()
        self._door: socket.socket | None = None
        self._port = 0
        self.restore()

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self._port}"

    def restore(self, max_bytes: int | None = None) -> None:
        """The network is back; for good, or until so many bytes have gone to the target."""
        self.num_bytes, self._max_bytes = 0, max_bytes
        door = socket.socket()
        door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        door.bind(("127.0.0.1", self._port))
        door.listen()
        self._door, self._port = door, door.getsockname()[1]
        threading.Thread(target=self._accept, args=(door,), daemon=True).start()

    def cut(self) -> None:
        """The network is down."""
        door, self._door = self._door, None
        with self._lock:
            ends, self._pairs = self._pairs, []
        for end in [*([door] if door else []), *ends]:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self, door: socket.socket) -> None:
        while True:
            try:
                near, _ = door.accept()
                far = socket.create_connection(self._target, timeout=5)
            except OSError:
                return
            far.settimeout(None)
            with self._lock:
                self._pairs += [near, far]
            for one, other, count in ((near, far, self._count), (far, near, len)):
                threading.Thread(target=_pump, args=(one, other, count), daemon=True).start()

    def _count(self, data: bytes) -> None:
        self.num_bytes += len(data)
        if self._max_bytes is not None and self.num_bytes > self._max_bytes:
            self.cut()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.cut()


def _pump(one: socket.socket, other: socket.socket, count: Callable[[bytes], object]) -> None:
    with contextlib.suppress(OSError):
        while data := one.recv(1 << 16):
            other.sendall(data)
            count(data)
    for end in (one, other):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
