"""Bit tricks that numba does not offer: iterate the set bits of a row mask."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


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
