"""Compiled loops. Their cache is named after the sources of all of them: a loop that another file's
loop calls may have changed, which the compiler's own cache would not notice."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba import njit

_HERE = Path(__file__).parent
_NAME = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(_HERE.glob("*.py")))).hexdigest()
CACHE = _HERE / "__pycache__" / f"kernels-{_NAME[:16]}"
KEPT = 3  # caches, that of these sources and the newest of others: each takes 24 MB


def make_room(cache: Path) -> bool:
    """Whether the cache can lie beside the sources; else the compiler finds a place of its own. A
    new one takes the place of the oldest."""
    is_new = not cache.exists()
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    with suppress(OSError):
        others = [other for other in cache.parent.glob("kernels-*") if other != cache]
        for old in sorted(others, key=lambda p: p.stat().st_mtime)[: 1 - KEPT] if is_new else ():
            shutil.rmtree(old)
    return True


_WRITABLE = make_room(CACHE)


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    parallel: bool = False,
    allocates: bool = True,
    inlined: bool = False,
) -> Any:
    """Compile a loop: without the interpreter's lock, cached, on all cores if `parallel`. What is
    divided by zero is infinite or no number, as in arrays.

    One that is `inlined` is always compiled into those that call it: loops with no other calls in
    them can take several turns at once.

    One that makes no array (allocates=False) borrows those it is given. Else it counts references
    to each of them, an atomic operation at every call and every look into a tuple: half of the time
    of small loops, and more where two threads count at the same arrays. (The option is numba's own
    name for it; one that does make an array is then refused by the compiler.)"""
    if function is None:
        return lambda own: kernel(own, parallel=parallel, allocates=allocates, inlined=inlined)
    options: Any = {"error_model": "numpy", "forceinline": inlined}
    if not allocates:
        options["_nrt"] = False
    config: Any = numba.config
    before = config.CACHE_DIR
    if _WRITABLE:
        config.CACHE_DIR = str(CACHE)
    try:
        return njit(cache=True, nogil=True, parallel=parallel, **options)(function)
    finally:
        config.CACHE_DIR = before
