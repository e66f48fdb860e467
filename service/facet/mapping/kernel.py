"""Compiled loops. Their cache is named after the sources of all of them: a loop that another file's
loop calls may have changed, which the compiler's own cache would not notice."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit

_HERE = Path(__file__).parent
_NAME = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(_HERE.glob("*.py")))).hexdigest()
CACHE = _HERE / "__pycache__" / f"kernels-{_NAME[:16]}"


def _writable() -> bool:
    """Whether the cache can lie beside the sources; else the compiler finds a place of its own."""
    try:
        CACHE.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return True


_WRITABLE = _writable()


def kernel(function: Callable[..., Any] | None = None, *, parallel: bool = False) -> Any:
    """Compile a loop: without the interpreter's lock, cached, on all cores if `parallel`."""
    if function is None:
        return lambda own: kernel(own, parallel=parallel)
    config: Any = numba.config
    before = config.CACHE_DIR
    if _WRITABLE:
        config.CACHE_DIR = str(CACHE)
    try:
        return njit(cache=True, nogil=True, parallel=parallel)(function)
    finally:
        config.CACHE_DIR = before
