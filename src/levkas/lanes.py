"""Sixteen float32 side by side, for compiled kernels: bands of a pixel, taken together.

LLVM's own vectorising of loops over bands leaves up to fifteen of them over, checks at each pixel
whether arrays overlap, and gives up where bands stand in different pixels. With a vector type the
kernels say what they mean; it becomes one, two or four registers of whatever machine runs it, with
the same bits on each. There is no fastmath; `fma` is rounded once by definition.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

WIDTH = 16
WORD, FLOAT = ir.IntType(32), ir.FloatType()
MARKS_VECTOR = ir.VectorType(ir.IntType(8), WIDTH)
VECTOR, BITS = ir.VectorType(FLOAT, WIDTH), ir.VectorType(ir.IntType(1), WIDTH)


class LanesType(types.Type):
    """Numba's type of sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


LANES = LanesType()


class MarksType(types.Type):
    """Numba's type of sixteen uint8."""

    def __init__(self) -> None:
        super().__init__(name="Marks")


MARKS = MarksType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


@register_model(MarksType)
class _MarksModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, MARKS_VECTOR)


def _pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    index = context.cast(builder, arguments[1], signature.args[1], types.intp)
    return builder.gep(array.data, [index])


def _vector_pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    element = context.get_data_type(signature.args[0].dtype)
    pointer = _pointer(context, builder, signature, arguments)
    return builder.bitcast(pointer, ir.VectorType(element, WIDTH).as_pointer())


def _splat(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), value, ir.Constant(WORD, 0))
    order = ir.Constant(ir.VectorType(WORD, WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(one, one, order)


def _call(builder: Any, name: str, kind: Any, arguments: Any, of: Any = None) -> Any:
    """Call one of LLVM's own functions on float32 or lanes; `of` is its kind where it gives another."""
    name += f".v{WIDTH}f32" if (of or kind) == VECTOR else ".f32"
    function = builder.module.globals.get(name)
    if function is None:
        signature = ir.FunctionType(kind, [a.type for a in arguments])
        function = ir.Function(builder.module, signature, name)
    return builder.call(function, arguments)


@intrinsic
def look(_typing: Any, array: Any, index: Any) -> Any:
    """Read one number of a flat array; a negative index does not count from the end."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_pointer(context, builder, signature, arguments))

    return array.dtype(array, index), generate


@intrinsic
def put(_typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write one number to a flat array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        element = signature.args[0].dtype
        value = context.cast(builder, arguments[2], signature.args[2], element)
        builder.store(value, _pointer(context, builder, signature, arguments))
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@intrinsic
def load(_typing: Any, array: Any, index: Any) -> Any:
    """Read sixteen numbers of a flat float32 or uint16 array from `index` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _vector_pointer(context, builder, signature, arguments)
        found = builder.load(pointer, align=signature.args[0].dtype.bitwidth // 8)
        return found if found.type == VECTOR else builder.uitofp(found, VECTOR)

    return LANES(array, index), generate


@intrinsic
def store(_typing: Any, array: Any, index: Any, lanes: Any) -> Any:
    """Write sixteen numbers to a flat float32 array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _vector_pointer(context, builder, signature, arguments)
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, index, lanes), generate


@intrinsic
def store_some(_typing: Any, array: Any, index: Any, lanes: Any, chosen: Any) -> Any:
    """Write those of sixteen numbers whose bit in `chosen`, uint16, is set; touch no other memory."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _vector_pointer(context, builder, signature, arguments)
        mask = builder.bitcast(arguments[3], BITS)
        kind = ir.FunctionType(ir.VoidType(), [VECTOR, pointer.type, WORD, BITS])
        name = f"llvm.masked.store.v{WIDTH}f32.p0"
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        builder.call(function, [arguments[2], pointer, ir.Constant(WORD, 4), mask])
        return context.get_dummy_value()

    return types.void(array, index, lanes, chosen), generate


@intrinsic
def constant(_typing: Any, like: Any, value: Any) -> Any:
    """Return `value` as float32, or sixteen of it where `like` is lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[1], signature.args[1], types.float32)
        return number if signature.return_type == types.float32 else _splat(builder, number)

    return (LANES if like == LANES else types.float32)(like, value), generate


@intrinsic
def splat(_typing: Any, value: Any) -> Any:
    """Return sixteen times one float32."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _splat(builder, arguments[0])

    return LANES(types.float32), generate


@intrinsic
def fma(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a·b + c, rounded once."""
    kind = LANES if a == LANES else types.float32

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.fma", arguments[0].type, arguments)

    return kind(kind, kind, kind), generate


@intrinsic
def whole(_typing: Any, value: Any) -> Any:
    """Return the largest whole number not above `value`, float32 or lanes."""
    kind = LANES if value == LANES else types.float32

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.floor", arguments[0].type, arguments)

    return kind(kind), generate


@intrinsic
def size(_typing: Any, value: Any) -> Any:
    """Return the absolute value of lanes."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.fabs", VECTOR, arguments)

    return LANES(LANES), generate


def _chosen(sign: str) -> Any:
    @intrinsic
    def choose(_typing: Any, a: Any, b: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return builder.select(builder.fcmp_ordered(sign, *arguments), *arguments)

        return LANES(LANES, LANES), generate

    return choose


smaller, larger = _chosen("<"), _chosen(">")
"""Of either sixteen; the second's where one is no number."""


def _over_all(name: str) -> Any:
    @intrinsic
    def reduce(_typing: Any, lanes: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return _call(builder, f"llvm.vector.reduce.{name}", FLOAT, arguments, of=VECTOR)

        return types.float32(LANES), generate

    return reduce


least, most = _over_all("fmin"), _over_all("fmax")
"""Of sixteen numbers."""


@intrinsic
def lane(_typing: Any, lanes: Any, index: Any) -> Any:
    """Return one of the sixteen."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        index = context.cast(builder, arguments[1], signature.args[1], types.int32)
        return builder.extract_element(arguments[0], index)

    return types.float32(lanes, index), generate


@intrinsic
def equal(_typing: Any, a: Any, b: Any) -> Any:
    """Return uint16 whose bits tell which of sixteen numbers are equal."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(builder.fcmp_ordered("==", *arguments), ir.IntType(16))

    return types.uint16(LANES, LANES), generate


@intrinsic
def lowest(_typing: Any, bits: Any) -> Any:
    """Return which bit of a uint16 is the lowest that is set."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        found = builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 0))
        return builder.zext(found, ir.IntType(64))

    return types.int64(types.uint16), generate


@intrinsic
def load_marks(_typing: Any, array: Any, index: Any) -> Any:
    """Read sixteen bytes of a flat uint8 array from `index` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_vector_pointer(context, builder, signature, arguments), align=1)

    return MARKS(array, index), generate


@intrinsic
def store_marks(_typing: Any, array: Any, index: Any, marks: Any) -> Any:
    """Write sixteen bytes to a flat uint8 array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _vector_pointer(context, builder, signature, arguments)
        builder.store(arguments[2], pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, index, marks), generate


@intrinsic
def no_marks(_typing: Any) -> Any:
    """Return sixteen times 0."""
    return MARKS(), lambda *_: ir.Constant(MARKS_VECTOR, [0] * WIDTH)


@intrinsic
def join(_typing: Any, a: Any, b: Any) -> Any:
    """Return the bits that either sixteen has."""
    return MARKS(MARKS, MARKS), lambda _context, builder, _signature, both: builder.or_(*both)


@intrinsic
def mark_where(_typing: Any, marks: Any, mark: Any) -> Any:
    """Return `mark`, uint8, for each of sixteen that is not 0, and 0 for the others."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        one = ir.Constant(MARKS_VECTOR, ir.Undefined)
        one = builder.insert_element(one, arguments[1], ir.Constant(WORD, 0))
        order = ir.Constant(ir.VectorType(WORD, WIDTH), [0] * WIDTH)
        nothing = ir.Constant(MARKS_VECTOR, [0] * WIDTH)
        found = builder.icmp_unsigned("!=", arguments[0], nothing)
        return builder.select(found, builder.shuffle_vector(one, one, order), nothing)

    return MARKS(MARKS, types.uint8), generate


@intrinsic
def all_marks(_typing: Any, marks: Any) -> Any:
    """Return the bits that any of sixteen has, uint8."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        name = f"llvm.vector.reduce.or.v{WIDTH}i8"
        kind = ir.FunctionType(ir.IntType(8), [MARKS_VECTOR])
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        return builder.call(function, arguments)

    return types.uint8(MARKS), generate


def _arithmetic(sign: Any, name: str) -> None:
    @intrinsic
    def combine(_typing: Any, a: Any, b: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return getattr(builder, name)(*arguments)

        return LANES(LANES, LANES), generate

    @overload(sign)
    def _combine(a, b):  # type: ignore[no-untyped-def]
        return (lambda a, b: combine(a, b)) if a == b == LANES else None


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")
