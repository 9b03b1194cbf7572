"""Sixteen float64 side by side, for compiled kernels: as `lanes`, where float32 does not do."""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from levkas.lanes import LANES, MARKS, MARKS_VECTOR, VECTOR, WIDTH, WORD

DOUBLE = ir.DoubleType()
DOUBLE_VECTOR = ir.VectorType(DOUBLE, WIDTH)
WORDS = ir.VectorType(WORD, WIDTH)


class DoublesType(types.Type):
    """Numba's type of sixteen float64."""

    def __init__(self) -> None:
        super().__init__(name="Doubles")


DOUBLES = DoublesType()


@register_model(DoublesType)
class _DoublesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, DOUBLE_VECTOR)


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(WORD, 0))
    return builder.shuffle_vector(one, one, ir.Constant(WORDS, [0] * WIDTH))


@intrinsic
def load_doubles(_typing: Any, array: Any, index: Any) -> Any:
    """Read sixteen numbers of a flat float64, uint16 or uint8 array from `index` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        data = context.make_array(kind)(context, builder, arguments[0]).data
        index = context.cast(builder, arguments[1], signature.args[1], types.intp)
        vector = ir.VectorType(context.get_data_type(kind.dtype), WIDTH).as_pointer()
        pointer = builder.bitcast(builder.gep(data, [index]), vector)
        found = builder.load(pointer, align=kind.dtype.bitwidth // 8)
        return found if found.type == DOUBLE_VECTOR else builder.uitofp(found, DOUBLE_VECTOR)

    return DOUBLES(array, index), generate


@intrinsic
def doubles(_typing: Any, value: Any) -> Any:
    """Return sixteen times one number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[0], signature.args[0], types.float64)
        return _spread(builder, number, DOUBLE_VECTOR)

    return DOUBLES(value), generate


@intrinsic
def positive(_typing: Any, value: Any) -> Any:
    """Return lanes or doubles, 0 in place of what is not above it."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        nothing = ir.Constant(arguments[0].type, [0.0] * WIDTH)
        return builder.select(builder.fcmp_ordered(">", arguments[0], nothing), *arguments, nothing)

    return value(value), generate


@intrinsic
def narrowed(_typing: Any, value: Any) -> Any:
    """Return doubles as lanes."""
    return LANES(DOUBLES), lambda _context, builder, _signature, both: builder.fptrunc(
        both[0], VECTOR
    )


@intrinsic
def root(_typing: Any, value: Any) -> Any:
    """Return square roots of lanes."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        name = f"llvm.sqrt.v{WIDTH}f32"
        kind = ir.FunctionType(VECTOR, [VECTOR])
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        return builder.call(function, arguments)

    return LANES(LANES), generate


@intrinsic
def round_bits(_typing: Any, value: Any, half: Any, keep: Any) -> Any:
    """Return lanes whose bits had `half` added and all taken away that `keep`, uint32, has not."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        half, keep = (
            _spread(builder, context.cast(builder, a, s, types.uint32), WORDS)
            for a, s in zip(arguments[1:], signature.args[1:], strict=True)
        )
        bits = builder.add(builder.bitcast(arguments[0], WORDS), half)
        return builder.bitcast(builder.and_(bits, keep), VECTOR)

    return LANES(LANES, half, keep), generate


def _marking(sign: str) -> Any:
    @intrinsic
    def mark(_typing: Any, value: Any, limit: Any, mark: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            limit = context.cast(builder, arguments[1], signature.args[1], types.float64)
            limits = _spread(builder, limit, DOUBLE_VECTOR)
            found = builder.fcmp_ordered(sign, arguments[0], limits)
            marks = _spread(builder, arguments[2], MARKS_VECTOR)
            return builder.select(found, marks, ir.Constant(MARKS_VECTOR, [0] * WIDTH))

        return MARKS(DOUBLES, limit, types.uint8), generate

    return mark


mark_least, mark_most = _marking(">="), _marking("<=")
"""Return `mark`, uint8, for each of sixteen doubles that is at least, or at most, a limit; else 0."""


def _arithmetic(sign: Any, name: str) -> None:
    @intrinsic
    def combine(_typing: Any, a: Any, b: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return getattr(builder, name)(*arguments)

        return DOUBLES(DOUBLES, DOUBLES), generate

    @overload(sign)
    def _combine(a, b):  # type: ignore[no-untyped-def]
        return (lambda a, b: combine(a, b)) if a == b == DOUBLES else None


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
