"""Sixteen numbers at once: vectors of float32 that a kernel computes with as it does with single numbers.

LLVM turns a loop over pixels into vectors by itself, but not a loop over lines each of which runs its own
iteration. With `Lanes` a kernel says so: a lane is a line. The operators + - * / and comparisons work lane by
lane; comparisons give a `Mask`, by which `where` chooses. On a processor with AVX-512 a vector is one
register, elsewhere two or four.

Sums may be taken in any order and multiplications joined with additions (`REDUCTION`); NaN stays NaN.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.extending import intrinsic, lower_builtin, register_model, type_callable
from numba.core.types import Array, Type, boolean, float32, int32, intp, void

from noise_model.compiled.kernel import REDUCTION, kernel

N_LANES = 16
"""Number of float32 in the widest registers."""

_FLOATS = ir.VectorType(ir.FloatType(), N_LANES)
_BITS = ir.VectorType(ir.IntType(1), N_LANES)
_FLAGS = tuple(sorted(REDUCTION))


class _LanesType(Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes({N_LANES})")


class _MaskType(Type):
    """Sixteen yes or no."""

    def __init__(self) -> None:
        super().__init__(name=f"Mask({N_LANES})")


LANES, MASK = _LanesType(), _MaskType()

Lanes = Any
"""Sixteen float32 within a kernel."""

COUNT = np.arange(N_LANES, dtype=np.float32)
"""0, 1 ... 15, to be loaded."""

Mask = Any
"""Sixteen answers within a kernel."""


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, type_: Type) -> None:
        super().__init__(manager, type_, _FLOATS)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, type_: Type) -> None:
        super().__init__(manager, type_, _BITS)


def _register(
    operation: Callable[..., Any], takes: Type, gives: Type, emit: Callable[[Any, Any, Any], Any]
) -> None:
    """Teach numba an operation of two vectors."""

    def typed(context: Any) -> Callable[[Type, Type], Type | None]:
        return lambda a, b: gives if (a, b) == (takes, takes) else None

    def written(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return emit(builder, *arguments)

    type_callable(operation)(typed)
    lower_builtin(operation, takes, takes)(written)


def _arithmetic(name: str) -> Callable[[Any, Any, Any], Any]:
    """Return the builder of an instruction for floating-point numbers."""
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_FLAGS)


def _comparison(sign: str) -> Callable[[Any, Any, Any], Any]:
    """Return the builder of a comparison that NaN never passes."""
    return lambda builder, a, b: builder.fcmp_ordered(sign, a, b)


for _operations, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _operation in _operations:
        _register(_operation, LANES, LANES, _arithmetic(_name))
for _compare, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _register(_compare, LANES, MASK, _comparison(_sign))
_register(operator.and_, MASK, MASK, lambda builder, a, b: builder.and_(a, b))
_register(operator.or_, MASK, MASK, lambda builder, a, b: builder.or_(a, b))


def _instruction(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the intrinsic whose `function` gives the types and writes LLVM's instructions."""
    instruction: Callable[..., Any] = intrinsic(function)
    return instruction


def _address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return the address of a vector in an array (n,) of float32."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.bitcast(builder.gep(array.data, [arguments[1]]), _FLOATS.as_pointer())


def _is_line(array: Type, n_axes: int = 1) -> bool:
    """Return True if a type is a contiguous array (n,) of float32, or of more axes."""
    return (
        isinstance(array, Array) and array.ndim == n_axes and array.layout == "C" and array.dtype == float32
    )


@_instruction
def load(_typing: Any, values: Any, _first: Any) -> Any:
    """Return the sixteen of contiguous values (n,), float32, from a place on."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        loaded = builder.load(_address(context, builder, signature, arguments))
        loaded.align = 4
        return loaded

    return (LANES(values, intp), write) if _is_line(values) else None


@_instruction
def store(_typing: Any, values: Any, _first: Any, lanes: Any) -> Any:
    """Write a vector into contiguous values (n,), float32, from a place on."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _address(context, builder, signature, arguments)).align = 4
        return context.get_dummy_value()

    return (void(values, intp, lanes), write) if _is_line(values) else None


@_instruction
def transpose(_typing: Any, rows: Any, _first: Any, into: Any) -> Any:
    """Write the sixteen from a place on of each row (N_LANES, n), float32, lane by lane from there on.

    The row's k-th number becomes its lane's of the k-th vector in `into` (N_LANES n,). Four times the upper
    eight vectors are shuffled with the lower eight, number by number.
    """

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        target = context.make_array(signature.args[2])(context, builder, arguments[2])
        length, half = cgutils.unpack_tuple(builder, array.shape, 2)[1], N_LANES // 2

        def vector(data: Any, place: Any) -> Any:
            return builder.bitcast(builder.gep(data, [place]), _FLOATS.as_pointer())

        vectors = []
        for lane in range(N_LANES):
            begin = builder.mul(length, ir.Constant(length.type, lane))
            vectors.append(builder.load(vector(array.data, builder.add(begin, arguments[1])), align=4))
        shuffles = [
            ir.Constant(
                ir.VectorType(ir.IntType(32), N_LANES),
                [first + k // 2 + N_LANES * (k % 2) for k in range(N_LANES)],
            )
            for first in (0, half)
        ]
        for _ in range(N_LANES.bit_length() - 1):
            vectors = [
                builder.shuffle_vector(vectors[k // 2], vectors[k // 2 + half], shuffles[k % 2])
                for k in range(N_LANES)
            ]
        begin = builder.mul(arguments[1], ir.Constant(length.type, N_LANES))
        for k in range(N_LANES):
            place = builder.add(begin, ir.Constant(length.type, N_LANES * k))
            builder.store(vectors[k], vector(target.data, place), align=4)
        return context.get_dummy_value()

    return (void(rows, intp, into), write) if _is_line(rows, 2) and _is_line(into) else None


@_instruction
def spread(_typing: Any, _value: Any) -> Any:
    """Return a vector whose lanes all hold one number, rounded to float32."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first = builder.insert_element(
            ir.Constant(_FLOATS, ir.Undefined), arguments[0], ir.Constant(ir.IntType(32), 0)
        )
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), N_LANES), [0] * N_LANES)
        return builder.shuffle_vector(first, first, everywhere)

    return LANES(float32), write


@_instruction
def where(_typing: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Return `yes` in the lanes of a mask, `no` in the others: two vectors, or two masks."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return (yes(mask, yes, no), write) if yes == no and yes in (LANES, MASK) else None


def _lane_by_lane(name: str) -> Callable[..., Any]:
    """Return the builder of one of LLVM's functions of a number, lane by lane."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FLOATS, [_FLOATS]), f"llvm.{name}.v{N_LANES}f32"
        )
        return builder.call(function, arguments)

    return write


@_instruction
def root(_typing: Any, lanes: Any) -> Any:
    """Return each lane's square root."""
    return LANES(lanes), _lane_by_lane("sqrt")


@_instruction
def floor(_typing: Any, lanes: Any) -> Any:
    """Return the greatest whole number that is no more than each lane."""
    return LANES(lanes), _lane_by_lane("floor")


@kernel(inline=True)
def lesser(a: Lanes, b: Lanes) -> Lanes:
    """Return the lesser of two vectors, lane by lane; `b` where one of them is NaN."""
    return where(a < b, a, b)


@kernel(inline=True)
def greater(a: Lanes, b: Lanes) -> Lanes:
    """Return the greater of two vectors, lane by lane; `b` where one of them is NaN."""
    return where(a > b, a, b)


def _answer(comparison: str, bits: int) -> Callable[..., Any]:
    """Return the builder of a comparison of a mask's bits with a number."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        answers = builder.bitcast(arguments[0], ir.IntType(N_LANES))
        return builder.icmp_unsigned(comparison, answers, ir.Constant(answers.type, bits))

    return write


@_instruction
def any_lane(_typing: Any, mask: Any) -> Any:
    """Return True if any lane of a mask is set."""
    return boolean(mask), _answer("!=", 0)


@_instruction
def all_lanes(_typing: Any, mask: Any) -> Any:
    """Return True if all lanes of a mask are set."""
    return boolean(mask), _answer("==", 2**N_LANES - 1)


def _across(name: str, takes: int) -> Callable[..., Any]:
    """Return the builder of a reduction of a vector to one number, from a start if LLVM wants one."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        single = ir.FloatType()
        start = [ir.Constant(single, 0.0)] if takes == 2 else []
        function = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(single, [*(value.type for value in start), _FLOATS]),
            f"llvm.vector.reduce.{name}.v{N_LANES}f32",
        )
        return builder.call(function, [*start, *arguments], fastmath=_FLAGS)

    return write


@_instruction
def total(_typing: Any, lanes: Any) -> Any:
    """Return the sum of all lanes."""
    return float32(lanes), _across("fadd", 2)


@_instruction
def least(_typing: Any, lanes: Any) -> Any:
    """Return the least of all lanes, none of which is NaN."""
    return float32(lanes), _across("fmin", 1)


@_instruction
def float_of(_typing: Any, _bits: Any) -> Any:
    """Return the float32 that is written with 32 bits."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return float32(int32), write


@_instruction
def bits_of(_typing: Any, _value: Any) -> Any:
    """Return the 32 bits with which a float32 is written."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return int32(float32), write
