"""Packs of eight doubles for numba: a node's fields side by side in one vector register.

numba has no vector type, and its optimiser does not find the one that frit's layout is made for: rho and seven order
parameters of a node are eight neighbouring doubles. `Pack` maps to LLVM's `<8 x double>`: one AVX-512 register, or two
AVX2 registers on older processors. Only four operations exist, all usable inside `@jit` functions alone.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 8
VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class PackType(types.Type):
    """The numba type of a pack of LANES doubles."""

    def __init__(self) -> None:
        super().__init__(name=f"Pack({LANES})")


pack = PackType()


@register_model(PackType)
class PackModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, frit_type: PackType) -> None:
        super().__init__(manager, frit_type, VECTOR)


def _broadcast(builder: Any, scalar: Any) -> Any:
    nothing = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, nothing, zeros)


def _address(context: Any, builder: Any, array_type: Any, array: Any, row: Any, column: Any) -> Any:
    """Address of array[row, column ... column + LANES - 1] in a C-contiguous 2-D array of doubles."""
    struct = context.make_array(array_type)(context, builder, array)
    width = cgutils.unpack_tuple(builder, struct.shape, 2)[1]
    element = builder.gep(struct.data, [builder.add(builder.mul(row, width), column)])
    return builder.bitcast(element, VECTOR.as_pointer())


@intrinsic
def load(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """load(array, row, column): the pack array[row, column : column + LANES]; no bounds are checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        result = builder.load(_address(context, builder, signature.args[0], *arguments))
        result.align = 8
        return result

    return pack(array, types.intp, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, row: Any, column: Any, value: Any) -> Any:
    """store(array, row, column, pack): write array[row, column : column + LANES]; no bounds are checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = _address(context, builder, signature.args[0], *arguments[:3])
        builder.store(arguments[3], address).align = 8
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, pack), generate


@intrinsic
def splat(typing: Any, scalar: Any) -> Any:
    """splat(x): the pack with x in every lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _broadcast(builder, arguments[0])

    return pack(types.float64), generate


@intrinsic
def fma(typing: Any, factor: Any, multiplied: Any, added: Any) -> Any:
    """fma(a, x, y): the pack a x + y for a scalar a."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        product = builder.fmul(_broadcast(builder, arguments[0]), arguments[1], flags=("contract",))
        return builder.fadd(product, arguments[2], flags=("contract",))

    return pack(types.float64, pack, pack), generate
