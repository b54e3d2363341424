"""A vector of lanes as a numba value: explicit SIMD in `njit` code.

`Vector` wraps LLVM's `<lanes x float>` or `<lanes x double>`. Arrays are read as rows of one vector each: the
last axis has `LANES` elements, and `load(array, row)` counts rows through all other axes in C order. A row fills
one register of the processor that numba compiles for: 16 lanes of float32 with AVX-512, 8 with AVX2, 4 with NEON
or SSE; half as many of float64.

Why not leave it to numba's auto-vectorizer? Measured, its loops are 2 to 10 times slower here: it cannot
prove that arrays do not overlap, and reloads coefficients in every pass.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.registry import cpu_target
from numba.extending import lower_builtin, register_model, type_callable
from numba.np.numpy_support import from_dtype
from numpy.typing import NDArray

intrinsic: Any = extending.intrinsic
"""Untyped on purpose: inside kernels its products are called without the typing context."""


def _target() -> tuple[int, bool]:
    """Return facts on numba's target: bytes of a vector register, and whether it fuses a * b + c.

    Both are read off the assembly of one multiplication and addition of 16 floats.
    """
    row = ir.VectorType(ir.FloatType(), 16)
    module = ir.Module()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [row.as_pointer()]), "multiply_add")
    builder = ir.IRBuilder(function.append_basic_block())
    value = builder.load(function.args[0])
    fused = ir.Function(module, ir.FunctionType(row, [row] * 3), "llvm.fmuladd.v16f32")
    builder.store(builder.call(fused, [value] * 3), function.args[0])
    builder.ret_void()
    machine = cpu_target.target_context.codegen()._tm
    assembly = machine.emit_assembly(llvmlite.binding.parse_assembly(str(module)))
    size = 64 if "zmm" in assembly else 32 if "ymm" in assembly else 16
    return size, "fmadd" in assembly or "fmla" in assembly


_BYTES, FUSED = _target()
LANES = {types.float32: _BYTES // 4, types.float64: _BYTES // 8}
"""Lanes of a vector by element type."""


def lanes(dtype: Any) -> int:
    """Return the number V of samples that are computed side by side."""
    return LANES[from_dtype(np.dtype(dtype))]


def aligned(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Allocate an array that begins at a multiple of 64 bytes, so that no vector straddles two cache lines."""
    room = np.empty(math.prod(shape) * np.dtype(dtype).itemsize + 64, np.uint8)
    first = -room.ctypes.data % 64
    array: NDArray[Any] = room[first : first + len(room) - 64].view(dtype).reshape(shape)
    return array


class Vector(types.Type):
    """Numba's type of a vector of lanes."""

    def __init__(self, element: Any) -> None:
        self.element = element
        super().__init__(name=f"Vector({element}, {LANES[element]})")

    @property
    def scalar(self) -> ir.Type:
        """LLVM's type of one lane."""
        return ir.FloatType() if self.element == types.float32 else ir.DoubleType()

    @property
    def llvm(self) -> ir.Type:
        """LLVM's type of the vector."""
        return ir.VectorType(self.scalar, LANES[self.element])

    @property
    def suffix(self) -> str:
        """How LLVM's intrinsic functions name this type."""
        return f"v{LANES[self.element]}f{32 if self.element == types.float32 else 64}"


VECTORS = {element: Vector(element) for element in LANES}


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, frontend: Vector) -> None:
        super().__init__(manager, frontend, frontend.llvm)


def _binary(function: Any, instruction: str) -> None:
    """Give vectors an arithmetic operator."""

    @type_callable(function)
    def typed(context: Any) -> Any:
        return lambda a, b: a if isinstance(a, Vector) and a == b else None

    for vector in VECTORS.values():

        @lower_builtin(function, vector, vector)
        def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            # "contract" lets multiplications and additions fuse; reordering is not allowed
            return getattr(builder, instruction)(*arguments, flags=("contract",))


for _operator, _instruction in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.isub, "fsub"),
    (operator.mul, "fmul"),
):
    _binary(_operator, _instruction)


def _row_pointer(context: Any, builder: Any, array_type: Any, array: Any, row: Any, vector: Vector) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    rows = builder.bitcast(data, vector.llvm.as_pointer())
    return builder.gep(rows, [row])


@intrinsic
def load(typing_context: Any, array: Any, row: Any) -> Any:
    """Return row `row` of an array as a vector."""
    vector = VECTORS[array.dtype]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _row_pointer(context, builder, signature.args[0], arguments[0], arguments[1], vector)
        return builder.load(pointer, align=4)

    return vector(array, types.intp), generate


@intrinsic
def store(typing_context: Any, array: Any, row: Any, value: Any) -> Any:
    """Write a vector to row `row` of an array."""
    vector = VECTORS[array.dtype]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _row_pointer(context, builder, signature.args[0], arguments[0], arguments[1], vector)
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


def _broadcast(builder: Any, vector: Vector, number: Any) -> Any:
    """Put one number into every lane."""
    undefined = ir.Constant(vector.llvm, ir.Undefined)
    one = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    lanes = LANES[vector.element]
    return builder.shuffle_vector(
        one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    )


@intrinsic
def splat(typing_context: Any, array: Any, scalar: Any) -> Any:
    """Return a vector with one number in every lane, of the element type of `array`."""
    vector = VECTORS[array.dtype]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[1], signature.args[1], vector.element)
        return _broadcast(builder, vector, number)

    return vector(array, scalar), generate


@intrinsic
def spread(typing_context: Any, array: Any, place: Any) -> Any:
    """Return a vector with the number at `place` of an array, counted in C order, in every lane."""
    vector = VECTORS[array.dtype]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return _broadcast(builder, vector, builder.load(builder.gep(data, [arguments[1]])))

    return vector(array, types.intp), generate


@intrinsic
def constant(typing_context: Any, like: Any, scalar: Any) -> Any:
    """Return a vector with one number in every lane, of the type of another vector."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[1], signature.args[1], like.element)
        return _broadcast(builder, like, number)

    return like(like, scalar), generate


def _function(name: str, arguments: int) -> Any:
    """Make one of LLVM's functions on vectors available."""

    def generate_for(vector: Vector) -> Any:
        def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            kind = ir.FunctionType(vector.llvm, [vector.llvm] * arguments)
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{vector.suffix}")
            return builder.call(function, given)

        return generate

    if arguments == 1:

        def unary(typing_context: Any, a: Any) -> Any:
            return a(a), generate_for(a)

        return intrinsic(unary)

    def ternary(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
        return a(a, a, a), generate_for(a)

    return intrinsic(ternary)


nearest = _function("nearbyint", 1)
floor = _function("floor", 1)
fma = _function("fmuladd", 3)
"""`fma(a, b, c)` is a * b + c, rounded once where the processor has such an instruction, else twice."""


def _zero(vector: Vector) -> ir.Constant:
    return ir.Constant(vector.llvm, [0.0] * LANES[vector.element])


@intrinsic
def positive(typing_context: Any, a: Any) -> Any:
    """Return max(a, 0); NaN stays NaN."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", arguments[0], _zero(a)), _zero(a), arguments[0])

    return a(a), generate


@intrinsic
def where_positive(typing_context: Any, a: Any, b: Any) -> Any:
    """Return b where a > 0, else 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", arguments[0], _zero(a)), arguments[1], _zero(a))

    return a(a, b), generate


@intrinsic
def transpose(
    typing_context: Any, source: Any, first: Any, stride: Any, target: Any, begin: Any, step: Any
) -> Any:
    """Transpose a square of V x V numbers: target[begin + c step + r] = source[first + r stride + c], in C order."""
    vector, lanes = VECTORS[source.dtype], LANES[source.dtype]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def pointers(which: int) -> Any:
            data = context.make_array(signature.args[which])(context, builder, arguments[which]).data
            place = arguments[which + 1]
            for _ in range(lanes):
                yield builder.bitcast(builder.gep(data, [place]), vector.llvm.as_pointer())
                place = builder.add(place, arguments[which + 2])

        rows = [builder.load(pointer, align=4) for pointer in pointers(0)]
        kind, half = ir.VectorType(ir.IntType(32), lanes), lanes // 2
        while half:  # rows r and r + half exchange their squares of `half` numbers
            low = [c if c // half % 2 == 0 else lanes + c - half for c in range(lanes)]
            high = [c + half if c // half % 2 == 0 else lanes + c for c in range(lanes)]
            for r in range(lanes):
                if r // half % 2 == 0:
                    upper, lower = rows[r], rows[r + half]
                    rows[r] = builder.shuffle_vector(upper, lower, ir.Constant(kind, low))
                    rows[r + half] = builder.shuffle_vector(upper, lower, ir.Constant(kind, high))
            half //= 2
        for row, pointer in zip(rows, pointers(3)):
            builder.store(row, pointer, align=4)
        return context.get_dummy_value()

    return types.void(source, types.intp, types.intp, target, types.intp, types.intp), generate


@intrinsic
def total(typing_context: Any, a: Any) -> Any:
    """Return the sum over the lanes, added in a fixed order (halves onto halves)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value, width = arguments[0], LANES[a.element]
        while width > 1:
            width //= 2
            undefined = ir.Constant(value.type, ir.Undefined)
            kind = ir.VectorType(ir.IntType(32), width)
            low = builder.shuffle_vector(value, undefined, ir.Constant(kind, list(range(width))))
            high = builder.shuffle_vector(value, undefined, ir.Constant(kind, list(range(width, 2 * width))))
            value = builder.fadd(low, high)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return a.element(a), generate
