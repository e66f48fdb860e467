"""Bit tricks that numba does not offer: iterate the set bits of a row mask."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from facet.mapping.kernel import kernel


def _trailing_zeros(typingctx: Any, word: Any) -> Any:
    """Index of the lowest set bit of a non-zero uint64 (LLVM's cttz)."""
    del typingctx, word

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        del context, signature
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), codegen


trailing_zeros: Any = intrinsic(_trailing_zeros)


def _population(typingctx: Any, word: Any) -> Any:
    """Number of set bits of a uint64 (LLVM's ctpop)."""
    del typingctx, word

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        del context, signature
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


population: Any = intrinsic(_population)


@kernel
def box_mask(x0: int, x1: int, y0: int, y1: int) -> np.uint64:
    """Bits x + 8 y with x0 <= x <= x1 and y0 <= y <= y1 (all 0..7)."""
    row = (np.uint64(1) << np.uint64(x1 + 1)) - (np.uint64(1) << np.uint64(x0))
    high = np.uint64(8 * y1 + 8)
    below_high = ~np.uint64(0) if high == np.uint64(64) else (np.uint64(1) << high) - np.uint64(1)
    below_low = (np.uint64(1) << np.uint64(8 * y0)) - np.uint64(1)
    return row * np.uint64(0x0101010101010101) & (below_high & ~below_low)
