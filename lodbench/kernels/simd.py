"""Eight values at a time: arithmetic on LLVM vectors, written as expressions.

The engine works on eight hypotheses side by side, one per lane. A plain loop over eight array
elements is not reliably turned into vector instructions (the compiler cannot know that two arrays
do not overlap), so the inner loops are written for LLVM directly, with ``Vector`` values. LLVM lowers
them to what the processor has, from SSE2 to AVX-512; float results are the same on all, because
nothing is reordered or fused.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils
from numba.np.arrayobj import make_array

from lodbench.kernels.arguments import LANES

BIT = ir.IntType(1)
I16 = ir.IntType(16)
I32 = ir.IntType(32)
I64 = ir.IntType(64)
F64 = ir.DoubleType()


class Vector:
    """Eight values of one LLVM type; operators act lane by lane, a plain number stands for all lanes."""

    __slots__ = ("builder", "value")

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    @property
    def _is_float(self) -> bool:
        return bool(self.value.type.element == F64)

    def _value_of(self, other: Vector | float) -> Any:
        if isinstance(other, Vector):
            return other.value
        return ir.Constant(self.value.type, [other] * LANES)

    def _apply(self, on_floats: str, on_integers: str, other: Vector | float) -> Vector:
        name = on_floats if self._is_float else on_integers
        return Vector(self.builder, getattr(self.builder, name)(self.value, self._value_of(other)))

    def __add__(self, other: Vector | float) -> Vector:
        return self._apply("fadd", "add", other)

    def __sub__(self, other: Vector | float) -> Vector:
        return self._apply("fsub", "sub", other)

    def __mul__(self, other: Vector | float) -> Vector:
        return self._apply("fmul", "mul", other)

    def __rshift__(self, bits: int) -> Vector:
        return self._apply("", "ashr", bits)

    def __lshift__(self, bits: int) -> Vector:
        return self._apply("", "shl", bits)

    def __and__(self, other: Vector | int) -> Vector:
        return self._apply("", "and_", other)

    def __or__(self, other: Vector | int) -> Vector:
        return self._apply("", "or_", other)

    def reciprocal(self) -> Vector:
        """Returns 1 / self, float lanes."""
        one = ir.Constant(self.value.type, [1.0] * LANES)
        return Vector(self.builder, self.builder.fdiv(one, self.value))

    def compare(self, operator: str, other: Vector | float) -> Vector:
        """Returns a mask: lanes where ``self operator other`` holds; never where a lane is NaN."""
        make = self.builder.fcmp_ordered if self._is_float else self.builder.icmp_signed
        return Vector(self.builder, make(operator, self.value, self._value_of(other)))

    def where(self, mask: Vector, other: Vector | float) -> Vector:
        """Returns these lanes where the mask is set, the other's elsewhere."""
        return Vector(self.builder, self.builder.select(mask.value, self.value, self._value_of(other)))

    def at_most(self, other: Vector | float) -> Vector:
        """Returns the lesser; the other where a lane is NaN."""
        return self.where(self.compare("<", other), other)

    def at_least(self, other: Vector | float) -> Vector:
        """Returns the greater; the other where a lane is NaN."""
        return self.where(self.compare(">", other), other)

    def floor(self) -> Vector:
        """Returns the greatest whole numbers not above, float lanes."""
        name = f"llvm.floor.v{LANES}f64"
        module = self.builder.module
        function = module.globals.get(name) or ir.Function(
            module, ir.FunctionType(self.value.type, [self.value.type]), name
        )
        return Vector(self.builder, self.builder.call(function, [self.value]))

    def low_bits(self) -> Vector:
        """Returns whole numbers in float lanes as 32 bits; what needs more is cut off, not undefined."""
        # The sum has these numbers in the lowest bits of its mantissa.
        shifted = (self + 1.5 * 2.0**52).value
        return Vector(self.builder, self.builder.bitcast(shifted, ir.VectorType(I64, LANES))).to(I32)

    def to(self, element: Any) -> Vector:
        """Returns the lanes as another type: floats are cut to whole numbers, masks become 0 and 1."""
        source, target = self.value.type.element, ir.VectorType(element, LANES)
        if source == F64:
            make = self.builder.fptosi
        elif element == F64:
            make = self.builder.sitofp
        elif source == BIT:
            make = self.builder.zext
        else:
            make = self.builder.sext if element.width > source.width else self.builder.trunc
        return Vector(self.builder, make(self.value, target))

    def bits(self) -> Any:
        """Returns a mask as an 8-bit LLVM integer, lane 0 lowest."""
        return self.builder.bitcast(self.value, ir.IntType(LANES))

    def extract(self, index: int) -> Any:
        """Returns the LLVM value of one lane."""
        return self.builder.extract_element(self.value, ir.Constant(I32, index))


class Memory:
    """The data of a C-contiguous numba array, read and written by LLVM index."""

    __slots__ = ("builder", "data")

    def __init__(self, context: Any, builder: Any, array_type: Any, array: Any) -> None:
        self.builder = builder
        self.data = make_array(array_type)(context, builder, array).data

    def _vector_at(self, index: Any) -> Any:
        here = self.builder.gep(self.data, [index])
        return self.builder.bitcast(here, ir.VectorType(self.data.type.pointee, LANES).as_pointer())

    def _alignment(self) -> int:
        element = self.data.type.pointee
        return 8 if element == F64 else int(element.width) // 8

    def load(self, index: Any) -> Vector:
        """Returns the eight elements from ``index`` on."""
        return Vector(self.builder, self.builder.load(self._vector_at(index), align=self._alignment()))

    def store(self, index: Any, vector: Vector) -> None:
        """Writes eight elements from ``index`` on."""
        self.builder.store(vector.value, self._vector_at(index), align=self._alignment())

    def load_scalar(self, index: Any) -> Any:
        """Returns the LLVM value of one element."""
        return self.builder.load(self.builder.gep(self.data, [index]))

    def store_scalar(self, index: Any, value: Any) -> None:
        """Writes one element."""
        self.builder.store(value, self.builder.gep(self.data, [index]))

    def broadcast(self, index: Any, element: Any = None) -> Vector:
        """Returns one element in all eight lanes, float32 as float64; integers widened to ``element``."""
        value = self.load_scalar(index)
        if value.type == ir.FloatType():
            value = self.builder.fpext(value, F64)
        elif element is not None and value.type.width < element.width:
            value = self.builder.sext(value, element)
        return broadcast(self.builder, value)


def broadcast(builder: Any, value: Any) -> Vector:
    """Returns a scalar LLVM value in all eight lanes."""
    vector = ir.VectorType(value.type, LANES)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(I32, 0))
    zeros = ir.Constant(ir.VectorType(I32, LANES), [0] * LANES)
    return Vector(builder, builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros))


def constant_index(number: int) -> Any:
    """Returns an LLVM index constant."""
    return ir.Constant(I64, number)


class Running:
    """A value that a loop updates (LLVM keeps it in a register)."""

    __slots__ = ("builder", "slot")

    def __init__(self, builder: Any, start: Any) -> None:
        self.builder = builder
        self.slot = cgutils.alloca_once_value(builder, start)

    def get(self) -> Any:
        """Returns the LLVM value now."""
        return self.builder.load(self.slot)

    def set(self, value: Any) -> None:
        """Sets the LLVM value."""
        self.builder.store(value, self.slot)


def arrays(context: Any, builder: Any, signature: Any, args: Any, which: Sequence[int]) -> list[Memory]:
    """Returns the memory of some array arguments of an intrinsic."""
    return [Memory(context, builder, signature.args[i], args[i]) for i in which]


def vector_offset(builder: Any, index: Any) -> Any:
    """Returns where the numbers of the ``index``-th vertex, triangle or edge begin in a flat array."""
    return builder.mul(index, constant_index(LANES))
