"""Where a live dashboard appears: a web or native Rerun that we start, or one that is there."""

from __future__ import annotations

import json
import logging
import os
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path
from types import TracebackType
from urllib.parse import quote, urlsplit

import rerun as rr
import rerun_cli

from facet.sinks.dashboard import Dashboard
from facet_protocol.codec import Message

logger = logging.getLogger(__name__)

GRPC_PORT, WEB_PORT = 9876, 9090  # Rerun's own; others when these are taken
MEMORY_LIMITS = ("--memory-limit", "2GB", "--server-memory-limit", "512MB")
CHECK_S = 1.0
BINARY = Path(rerun_cli.__file__).with_name("rerun")  # not the wrapper: killing that orphans it

# Runs the viewer so that it ends when we do, however we end: PR_SET_PDEATHSIG, SIGKILL.
TIED_TO_PARENT = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); os.execv(sys.argv[1], sys.argv[1:])"
)


class Screen:
    """A stream into a viewer, made anew when the viewer has gone. One thread."""

    def __init__(self, target: str, map_id: str, bind: str = "127.0.0.1") -> None:
        """Raises ValueError for a target that is not web, native or connect:URL."""
        self._target, self._map_id, self._bind = target, map_id, bind
        self._child: subprocess.Popen[bytes] | None = None
        self._stream: rr.RecordingStream | None = None
        self._dashboard: Dashboard | None = None
        self._is_fresh = False
        self._checked_s = 0.0
        self._recording_id = uuid.uuid4().hex  # a viewer that comes back shows one recording
        self._url = self._viewer_url()
        self._settings = tempfile.TemporaryDirectory(prefix="facet-viewer-")

    def _viewer_url(self) -> str:
        if self._target.startswith("connect:"):
            return self._target.removeprefix("connect:")
        if self._target not in ("web", "native"):
            raise ValueError(f"viewer {self._target!r} is not web, native or connect:URL")
        self._port = _free_port(GRPC_PORT, self._bind)
        self._web_port = _free_port(WEB_PORT, self._bind)
        return f"rerun+http://127.0.0.1:{self._port}/proxy"

    def ready(self) -> bool:
        """Whether there is a viewer to draw into; looks for one now and then when there is none."""
        now = time.monotonic()
        if now - self._checked_s < CHECK_S:
            return self._dashboard is not None
        self._checked_s = now
        if self._dashboard is not None and not self._is_taken():
            logger.info("the viewer at %s has gone", self._url)
            self._dashboard = self._stream = None
        if self._dashboard is None:
            self._start_child()
            self._connect()
        return self._dashboard is not None

    def take_fresh(self) -> bool:
        """True once after each new connection: everything has to be drawn."""
        fresh, self._is_fresh = self._is_fresh, False
        return fresh

    def draw(self, message: Message) -> None:
        if self._dashboard is not None:
            self._dashboard.draw(message)

    def _is_taken(self) -> bool:
        """Draw what waits, and see whether the viewer still takes it."""
        assert self._stream is not None
        assert self._dashboard is not None
        self._dashboard.flush()
        try:
            self._stream.flush(timeout_sec=CHECK_S)
        except RuntimeError:
            return False
        return True

    def _start_child(self) -> None:
        """The viewer itself, on loopback unless told otherwise; again when it has ended."""
        if self._target.startswith("connect:"):
            return
        if self._child is not None and self._child.poll() is None:
            return
        self._refuse_telemetry()
        arguments = ["--bind", self._bind, "--port", str(self._port), *MEMORY_LIMITS]
        if self._target == "web":
            arguments += ["--serve-web", "--web-viewer-port", str(self._web_port)]
        self._child = subprocess.Popen(
            [sys.executable, "-I", "-c", TIED_TO_PARENT, str(BINARY), *arguments],
            env=self._environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        if self._target == "web":
            page = f"http://127.0.0.1:{self._web_port}/?url={quote(self._url, safe='')}"
            logger.info("dashboard of %s at %s", self._map_id, page)

    def _environment(self) -> dict[str, str]:
        return os.environ | {"XDG_CONFIG_HOME": self._settings.name}

    def _refuse_telemetry(self) -> None:
        """Rerun reports its use unless its settings say no: it gets settings that say no."""
        settings = Path(self._settings.name, "rerun", "analytics.json")
        settings.parent.mkdir(exist_ok=True)
        settings.write_text(
            json.dumps({"analytics_enabled": False, "analytics_id": "", "metadata": {}})
        )

    def _connect(self) -> None:
        """A new stream, if something listens: connecting to nobody would take seconds."""
        address = urlsplit(self._url.removeprefix("rerun+"))
        try:
            with socket.create_connection((address.hostname, address.port), timeout=CHECK_S):
                pass
        except OSError:
            return
        stream = rr.RecordingStream("facet", recording_id=self._recording_id)
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.connect_grpc(self._url)
        self._stream, self._dashboard, self._is_fresh = stream, Dashboard(stream), True
        logger.info("drawing into %s", self._url)

    def close(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child.wait()
            self._child = None
        self._settings.cleanup()

    def __enter__(self) -> Screen:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _free_port(preferred: int, bind: str) -> int:
    for port in (preferred, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((bind, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise OSError(f"no port is free on {bind}")
