"""Sixteen 16-bit integers side by side, and sums of their products, in vector registers.

A compiler that takes several turns of a loop at once makes 32-bit numbers of 16-bit ones before it
multiplies them: twice the registers, and four times the steps. Here a loop says what it means:

    w = load(weights, i) & (load(distances, i) <= reach)
    xx = add_products(xx, w * x, x)

Nothing is one processor's own: the compiler finds the instructions of each.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import imputils
from numba.core.typing import templates
from numba.extending import intrinsic, models, register_model

_imputils: Any = imputils  # typed in part only
_templates: Any = templates

LANES = 16
_I16 = ir.VectorType(ir.IntType(16), LANES)
_I32 = ir.VectorType(ir.IntType(32), LANES)
_SUM = ir.VectorType(ir.IntType(32), LANES // 2)
_I64 = ir.VectorType(ir.IntType(64), LANES)
QUARTERS = LANES // 4  # 64-bit numbers that `load` and `store` move at a time


class _Vector(types.Type):
    """A vector register, as loops know it."""


_LANES, _SUMS = _Vector("lanes"), _Vector("sums")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, own):  # type: ignore[no-untyped-def]
        super().__init__(manager, own, _I16 if own == _LANES else _SUM)


def _constant(value: int) -> Any:
    return ir.Constant(_I16, [value] * LANES)


def _spread(context: Any, builder: Any, number: Any, kind: Any, lane: Any = types.int16) -> Any:
    """A number in all lanes, of the type of one."""
    one = context.cast(builder, number, kind, lane)
    nothing = ir.Constant(ir.VectorType(ir.IntType(lane.bitwidth), LANES), [0] * LANES)
    first = builder.insert_element(nothing, one, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, first, ir.Constant(_I32, [0] * LANES))


def _define(name: Any, kinds: tuple[Any, ...], build: Callable[..., Any]) -> None:
    """What an operator of Python does to lanes; to a number as if it were in all lanes."""
    cases = [_templates.signature(_LANES, *kinds)]
    kind = type("_Template", (_templates.ConcreteTemplate,), {"cases": cases})
    _templates.infer_global(name)(kind)

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = zip(args, signature.args, strict=True)
        lanes = (v if k == _LANES else _spread(context, builder, v, k) for v, k in pairs)
        return build(builder, *lanes)

    _imputils.lower_builtin(name, *kinds)(lower)


def _compare(sign: str) -> Callable[..., Any]:
    """All bits where it holds, else none."""
    return lambda builder, x, y: builder.sext(builder.icmp_signed(sign, x, y), _I16)


def _absolute(builder: Any, x: Any) -> Any:
    zero = _constant(0)
    return builder.select(builder.icmp_signed("<", x, zero), builder.sub(zero, x), x)


_OPERATORS: dict[Any, Callable[..., Any]] = {
    operator.add: lambda builder, x, y: builder.add(x, y),
    operator.sub: lambda builder, x, y: builder.sub(x, y),
    operator.mul: lambda builder, x, y: builder.mul(x, y),
    operator.and_: lambda builder, x, y: builder.and_(x, y),
    operator.or_: lambda builder, x, y: builder.or_(x, y),
    operator.rshift: lambda builder, x, y: builder.ashr(x, y),
    operator.lt: _compare("<"),
    operator.le: _compare("<="),
    operator.gt: _compare(">"),
    operator.ge: _compare(">="),
}
for _operator, _build in _OPERATORS.items():
    _define(_operator, (_LANES, _LANES), _build)
    _define(_operator, (_LANES, types.int64), _build)
_define(abs, (_LANES,), _absolute)


def _address(context: Any, builder: Any, kinds: Any, args: Any, kind: Any = _I16) -> Any:
    """Of a register of that kind from args[1] on in the array args[0]."""
    array = context.make_array(kinds[0])(context, builder, args[0])
    at = context.cast(builder, args[1], kinds[1], types.intp)
    return builder.bitcast(builder.gep(array.data, [at]), kind.as_pointer())


def _load(typingctx: Any, column: Any, at: Any) -> Any:
    """LANES numbers from column[at] on, column (N,) int16; or QUARTERS of int64, to store again."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, signature.args, args), align=2)

    return _LANES(column, at), codegen


def _store(typingctx: Any, column: Any, at: Any, lanes: Any) -> Any:
    """Write LANES numbers to column[at] and on, column (N,) int16; or QUARTERS, of int64."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, signature.args, args), align=2)
        return context.get_dummy_value()

    return types.void(column, at, lanes), codegen


def _load_part(typingctx: Any, column: Any, at: Any, low: Any) -> Any:
    """Bits low .. low + 15 of LANES numbers from column[at] on, column (N,) int64."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = builder.load(_address(context, builder, signature.args, args, _I64), align=8)
        shift = _spread(context, builder, args[2], signature.args[2], types.int64)
        return builder.trunc(builder.lshr(wide, shift), _I16)

    return _LANES(column, at, low), codegen


def _splat(typingctx: Any, number: Any) -> Any:
    """A number in all lanes."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(context, builder, args[0], signature.args[0])

    return _LANES(number), codegen


def _larger(typingctx: Any, one: Any, other: Any) -> Any:
    """Of each pair the larger."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        del context, signature
        return builder.select(builder.icmp_signed(">", args[0], args[1]), args[0], args[1])

    return _LANES(one, other), codegen


def _no_sums(typingctx: Any) -> Any:
    """Sums of nothing."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        del context, builder, signature, args
        return ir.Constant(_SUM, [0] * (LANES // 2))

    return _SUMS(), codegen


def _add_products(typingctx: Any, sums: Any, one: Any, other: Any) -> Any:
    """Sums, and the products of two lanes, in 32 bits."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        del context, signature
        sums, *both = args
        wide = builder.mul(*(builder.sext(lanes, _I32) for lanes in both))
        pairs = (ir.Constant(_SUM, list(range(start, LANES, 2))) for start in (0, 1))
        even, odd = (builder.shuffle_vector(wide, wide, places) for places in pairs)
        return builder.add(sums, builder.add(even, odd))

    return _SUMS(sums, one, other), codegen


def _total(typingctx: Any, sums: Any) -> Any:
    """All of the sums, as one number."""
    del typingctx

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        del context, signature
        (left,) = args
        width = LANES // 2
        while width > 1:
            width //= 2
            halves = (range(width), range(width, 2 * width))
            kind = ir.VectorType(ir.IntType(32), width)
            parts = (builder.shuffle_vector(left, left, ir.Constant(kind, [*h])) for h in halves)
            left = builder.add(*parts)
        return builder.extract_element(left, ir.Constant(ir.IntType(32), 0))

    return types.int32(sums), codegen


load: Any = intrinsic(_load)
load_part: Any = intrinsic(_load_part)
store: Any = intrinsic(_store)
splat: Any = intrinsic(_splat)
larger: Any = intrinsic(_larger)
no_sums: Any = intrinsic(_no_sums)
add_products: Any = intrinsic(_add_products)
total: Any = intrinsic(_total)
