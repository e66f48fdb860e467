"""Nothing is compiled, or read from the compiler's cache, once the mapper is warm."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

DRIVE = """
import gc, logging, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from fault_rig import SETTINGS
from facet.warmup import warm_up
from test_soak import Fleet, drives, lap

def loaded():
    kernels = [d for d in gc.get_objects() if isinstance(d, Dispatcher)]
    return {(d.py_func.__module__, d.py_func.__name__, s) for d in kernels for s in d.overloads}

logging.disable(logging.WARNING)
warm_up(SETTINGS)
warm = loaded()
line = Fleet(Path(sys.argv[1]))
for batch, _ in zip(drives(lap()[::3], 1), range(40)):
    line.take(batch)
    line.update()
    line.take([])
    line.update()
line.mapper.counts()
line.mapper.points()
line.mapper.digest()
sys.exit("\\n".join(f"{m}.{name}{s}" for m, name, s in sorted(loaded() - warm, key=str)) or 0)
"""


def test_a_robot_waits_for_no_compiler(tmp_path: Path) -> None:
    """In a process of its own: others of these tests have loaded loops as well. Much comes at once
    at first, little later, and in every second update nothing."""
    command = [sys.executable, "-c", DRIVE, str(tmp_path)]
    ended = subprocess.run(
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
