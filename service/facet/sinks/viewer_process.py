"""Starts and stops the dashboard's process. Imports no Rerun: the mapper's process stays small."""

from __future__ import annotations

import subprocess
import sys

STOP_S = 1.5  # the viewer cuts itself off after one second


def start_viewer(
    endpoint: str, map_id: str, target: str, bind: str = "127.0.0.1"
) -> subprocess.Popen[bytes]:
    """A process that follows the map at `endpoint`; it ends when this process does.

    `target` is web, native or connect:URL. The address of a web dashboard is in its log (stderr).
    """
    command = [sys.executable, "-m", "facet.sinks.viewer", endpoint, map_id, target]
    return subprocess.Popen([*command, "--bind", bind, "--tied"], stdin=subprocess.DEVNULL)


def stop_viewer(process: subprocess.Popen[bytes]) -> None:
    """Ask, then kill; returns within STOP_S whatever the viewer does."""
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
