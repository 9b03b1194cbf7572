"""Sixteen rows of sixteen numbers turned in registers, for compiled kernels.

Bands that lie apart are brought side by side, and back: number by number that takes longer than what is
worked out of them.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

SIDE = 16


@intrinsic
def turn_square(_typing: Any, source: Any, at: Any, step: Any, out: Any, to: Any, wide: Any) -> Any:
    """Copy 16 x 16 numbers of a flat array to another of the same type, rows as columns.

    Rows begin at `at`, `step` apart, and are written from `to` on, `wide` apart.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        element = context.get_data_type(signature.args[0].dtype)
        align = max(1, signature.args[0].dtype.bitwidth // 8)

        def place(array: int, index: int, step: int, row: int) -> Any:
            kind = signature.args[array]
            data = context.make_array(kind)(context, builder, arguments[array]).data
            start, apart = (
                context.cast(builder, arguments[n], signature.args[n], types.intp)
                for n in (index, step)
            )
            index = builder.add(start, builder.mul(apart, ir.Constant(start.type, row)))
            vector = ir.VectorType(element, SIDE).as_pointer()
            return builder.bitcast(builder.gep(data, [index]), vector)

        rows = [builder.load(place(0, 1, 2, row), align=align) for row in range(SIDE)]
        for row, lanes in enumerate(_turned(builder, rows)):
            builder.store(lanes, place(3, 4, 5, row), align=align)
        return context.get_dummy_value()

    return types.void(source, at, step, out, to, wide), generate


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """Exchange what lies across the diagonal: halves, then quarters, eighths, single numbers."""
    width = SIDE // 2
    while width:
        for top in range(SIDE):
            if top & width:
                continue
            low, high = (
                [
                    (lane | half) if not lane & width else SIDE + (lane & ~width | half)
                    for lane in range(SIDE)
                ]
                for half in (0, width)
            )
            pair = rows[top], rows[top | width]
            rows[top], rows[top | width] = (
                builder.shuffle_vector(
                    *pair, ir.Constant(ir.VectorType(ir.IntType(32), SIDE), order)
                )
                for order in (low, high)
            )
        width //= 2
    return rows
