"""Nothing is compiled, or read from the compiler's cache, once the mapper is warm."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from facet.mapping.kernel import KEPT, make_room

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


def test_a_new_cache_takes_the_place_of_the_oldest(tmp_path: Path) -> None:
    """Each edit of the sources, and each version, has one of its own."""
    for age in range(1, 6):
        (tmp_path / f"kernels-{age}").mkdir()
        (tmp_path / f"kernels-{age}" / "loop.nbc").write_text("compiled")
        os.utime(tmp_path / f"kernels-{age}", (1e9 - age, 1e9 - age))
    (tmp_path / "mapper.pyc").write_text("not ours")
    assert make_room(tmp_path / "kernels-3")  # it is there: nothing goes
    assert len(list(tmp_path.glob("kernels-*"))) == 5
    assert make_room(tmp_path / "kernels-new")
    assert {p.name for p in tmp_path.glob("kernels-*")} == {"kernels-new", "kernels-1", "kernels-2"}
    assert KEPT == 3
    assert (tmp_path / "mapper.pyc").exists()
    assert not make_room(tmp_path / "mapper.pyc" / "kernels-new")  # nor can one lie there
