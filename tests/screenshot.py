"""Pictures of an .rrd without a display: `python tests/screenshot.py FILE.rrd OUT.png`.

A tool for whoever changes the dashboard; not run by the tests. Needs Vulkan in software:
`apt-get install --no-install-recommends mesa-vulkan-drivers libudev1`.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import rerun as rr
import rerun_cli

BINARY = Path(rerun_cli.__file__).with_name("rerun")  # not the wrapper: killing that orphans it
SOFTWARE_VULKAN = "/usr/share/vulkan/icd.d/lvp_icd.x86_64.json"
START_S = 30.0


def screenshot(recording: Path, picture: Path, settle_s: float, size: str) -> None:
    """Open the recording in a headless viewer, wait, and save what it shows."""
    port = _free_port()
    viewer = subprocess.Popen(
        [BINARY, "--headless", "--bind", "127.0.0.1", "--port", str(port),
         "--memory-limit", "2GB", "--window-size", size],
        env=os.environ | {"VK_ICD_FILENAMES": SOFTWARE_VULKAN, "WGPU_BACKEND": "vulkan"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        client = _connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.open(str(recording.resolve()))
        time.sleep(settle_s)
        client.save_screenshot(str(picture.resolve()))
    finally:
        viewer.kill()
        viewer.wait()


def _connect(url: str) -> rr.experimental.ViewerClient:
    deadline = time.monotonic() + START_S
    while True:
        try:
            return rr.experimental.ViewerClient.connect(url)
        except Exception:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    settle_s = float(sys.argv[3]) if len(sys.argv) > 3 else 8.0
    screenshot(Path(sys.argv[1]), Path(sys.argv[2]), settle_s, "1600x950")
