"""Packs of eight doubles for numba: a node's fields side by side in one vector register.

numba has no vector type, and its optimiser does not find the one that frit's layout is made for: rho and seven order
parameters of a node are eight neighbouring doubles. A pack maps to LLVM's `<8 x double>`: one AVX-512 register, or two
AVX2 registers on older processors. Inside `@jit` functions `load`, `store` and `splat` move packs (`get` and `put` by
the address that `place` tells), + - * work on them and with floats, so that a formula written for a float also serves
a pack, and `from_lane`, `total`, `first`, `with_first`, `positive` and `transpose` do what their names say.

Far from all particles fields fall below 1e-308, where processors calculate a hundred times slower: between
`flush_denormals` and `restore_denormals` such numbers are 0.
"""

import operator
import platform
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from .arrays import Floats

LANES = 8
DOUBLE = ir.DoubleType()
VECTOR = ir.VectorType(DOUBLE, LANES)
FAST = ("contract", "reassoc", "nsz")


class PackType(types.Type):
    """The numba type of a pack of LANES doubles."""

    def __init__(self) -> None:
        super().__init__(name=f"Pack({LANES})")


pack = PackType()


@register_model(PackType)
class PackModel(models.PrimitiveModel):
    """A pack is an LLVM vector."""

    def __init__(self, manager: Any, frit_type: PackType) -> None:
        super().__init__(manager, frit_type, VECTOR)  # type: ignore[no-untyped-call]  # numba's is not annotated


def _index(lane: int) -> Any:
    return ir.Constant(ir.IntType(32), lane)


def _broadcast(builder: Any, scalar: Any) -> Any:
    nothing = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(nothing, scalar, _index(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, nothing, zeros)


def _address(context: Any, builder: Any, array_type: Any, array: Any, row: Any, column: Any) -> Any:
    """Address of array[row, column ... column + LANES - 1] in a C-contiguous 2-D array of doubles."""
    struct = context.make_array(array_type)(context, builder, array)
    width = builder.extract_value(struct.shape, 1)
    element = builder.gep(struct.data, [builder.add(builder.mul(row, width), column)])
    return builder.bitcast(element, VECTOR.as_pointer())


@intrinsic
def _load(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """load(array, row, column): the pack array[row, column : column + LANES]; no bounds are checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        result = builder.load(_address(context, builder, signature.args[0], *arguments))
        result.align = 8
        return result

    return pack(array, types.intp, types.intp), generate


@intrinsic
def _store(typing: Any, array: Any, row: Any, column: Any, value: Any) -> Any:
    """store(array, row, column, pack): write array[row, column : column + LANES]; no bounds are checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = _address(context, builder, signature.args[0], *arguments[:3])
        builder.store(arguments[3], address).align = 8
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, pack), generate


@intrinsic
def _place(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """place(array, row, column): the address of array[row, column]; good while the array lives."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ptrtoint(_address(context, builder, signature.args[0], *arguments), ir.IntType(64))

    return types.intp(array, types.intp, types.intp), generate


@intrinsic
def _get(typing: Any, address: Any) -> Any:
    """get(address): the pack that begins there."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        result = builder.load(builder.inttoptr(arguments[0], VECTOR.as_pointer()))
        result.align = 8
        return result

    return pack(types.intp), generate


@intrinsic
def _put(typing: Any, address: Any, value: Any) -> Any:
    """put(address, pack): write it there."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[1], builder.inttoptr(arguments[0], VECTOR.as_pointer())).align = 8
        return context.get_dummy_value()

    return types.void(types.intp, pack), generate


@intrinsic
def _fetch(typing: Any, address: Any) -> Any:
    """fetch(address): bring the line of that address near, for later."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer, kind = ir.IntType(8).as_pointer(), ir.IntType(32)
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", (pointer,), ir.FunctionType(ir.VoidType(), [pointer, kind, kind, kind])
        )
        reading, soon, data = 0, 2, 1
        flags = [ir.Constant(kind, flag) for flag in (reading, soon, data)]
        builder.call(function, [builder.inttoptr(arguments[0], pointer), *flags])
        return context.get_dummy_value()

    return types.void(types.intp), generate


@intrinsic(prefer_literal=True)
def _from_lane(typing: Any, first: Any, second: Any, lane: Any) -> Any:
    """from_lane(a, b, n): lanes n ... LANES - 1 of a, and after them the first n of b; n is written as a number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        n = signature.args[2].literal_value
        chosen = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [n + k for k in range(LANES)])
        return builder.shuffle_vector(arguments[0], arguments[1], chosen)

    return (pack(pack, pack, lane), generate) if isinstance(lane, types.IntegerLiteral) else None


@intrinsic
def _splat(typing: Any, scalar: Any) -> Any:
    """splat(x): the pack with x in every lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _broadcast(builder, arguments[0])

    return pack(types.float64), generate


@intrinsic
def _first(typing: Any, value: Any) -> Any:
    """first(pack): lane 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.extract_element(arguments[0], _index(0))

    return types.float64(pack), generate


@intrinsic
def _with_first(typing: Any, value: Any, scalar: Any) -> Any:
    """with_first(pack, x): the pack with x in lane 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.insert_element(arguments[0], arguments[1], _index(0))

    return pack(pack, types.float64), generate


@intrinsic
def _total(typing: Any, value: Any) -> Any:
    """total(pack): the sum of the lanes, by halves."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value, lanes = arguments[0], LANES
        while lanes > 1:
            lanes //= 2
            nothing = ir.Constant(value.type, ir.Undefined)
            chosen = ir.VectorType(ir.IntType(32), lanes)
            low = builder.shuffle_vector(value, nothing, ir.Constant(chosen, list(range(lanes))))
            high = builder.shuffle_vector(value, nothing, ir.Constant(chosen, list(range(lanes, 2 * lanes))))
            value = builder.fadd(low, high, flags=FAST)
        return builder.extract_element(value, _index(0))

    return types.float64(pack), generate


@intrinsic
def _positive(typing: Any, value: Any) -> Any:
    """positive(x): max(x, 0) of a float, or in every lane of a pack."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        zero = ir.Constant(VECTOR, [0.0] * LANES) if isinstance(value, PackType) else ir.Constant(DOUBLE, 0.0)
        return builder.select(builder.fcmp_ordered(">", arguments[0], zero), arguments[0], zero)

    return value(value), generate


@intrinsic
def _transpose(
    typing: Any, array: Any, row: Any, column: Any, target: Any, target_row: Any, target_column: Any
) -> Any:
    """transpose(array, row, column, target, target_row, target_column): target's square of LANES rows and columns
    that begins there becomes array's, rows and columns exchanged; no bounds are checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, row, column, target, target_row, target_column = arguments
        kind, target_kind = signature.args[0], signature.args[3]
        packs = []
        for lane in range(LANES):
            line = builder.add(row, ir.Constant(row.type, lane))
            packs.append(builder.load(_address(context, builder, kind, array, line, column)))
            packs[-1].align = 8
        chosen = ir.VectorType(ir.IntType(32), LANES)
        distance = 1
        while distance < LANES:  # squares of 2 x 2 exchange two corners, then those of 4 x 4, then the whole
            low = [j + (LANES - distance if j & distance else 0) for j in range(LANES)]
            high = [j + LANES if j & distance else j + distance for j in range(LANES)]
            for lane in range(LANES):
                if not lane & distance:
                    pair = packs[lane], packs[lane + distance]
                    packs[lane] = builder.shuffle_vector(*pair, ir.Constant(chosen, low))
                    packs[lane + distance] = builder.shuffle_vector(*pair, ir.Constant(chosen, high))
            distance *= 2
        for lane in range(LANES):
            line = builder.add(target_row, ir.Constant(target_row.type, lane))
            address = _address(context, builder, target_kind, target, line, target_column)
            builder.store(packs[lane], address).align = 8
        return context.get_dummy_value()

    place = types.intp
    return types.void(array, place, place, target, place, place), generate


FLUSH = 0x8040  # bits of MXCSR: results below the normal range become 0, and such operands count as 0
X86 = platform.machine() in ("x86_64", "AMD64")


def _control(builder: Any, name: str, pointer: Any) -> None:
    """Call llvm.x86.sse.stmxcsr or ldmxcsr; other processors have no such register, and nothing is called."""
    if X86:
        address = ir.IntType(8).as_pointer()
        function = builder.module.declare_intrinsic(
            f"llvm.x86.sse.{name}", (), ir.FunctionType(ir.VoidType(), [address])
        )
        builder.call(function, [builder.bitcast(pointer, address)])


@intrinsic
def _flush_denormals(typing: Any) -> Any:
    """flush_denormals(): from here on no denormal numbers; returns what `restore_denormals` needs."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.IntType(32)
        mode = builder.alloca(kind)
        builder.store(ir.Constant(kind, 0), mode)
        _control(builder, "stmxcsr", mode)
        before = builder.load(mode)
        builder.store(builder.or_(before, ir.Constant(kind, FLUSH)), mode)
        _control(builder, "ldmxcsr", mode)
        return before

    return types.int32(), generate


@intrinsic
def _restore_denormals(typing: Any, before: Any) -> Any:
    """restore_denormals(before): undo `flush_denormals`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        mode = builder.alloca(arguments[0].type)
        builder.store(arguments[0], mode)
        _control(builder, "ldmxcsr", mode)
        return context.get_dummy_value()

    return types.void(types.int32), generate


class Pack(Protocol):
    """A pack as kernels see it: for type checkers alone, which know neither `PackType` nor `_overload`."""

    def __add__(self, other: "Pack | float", /) -> "Pack": ...
    def __radd__(self, other: float, /) -> "Pack": ...
    def __sub__(self, other: "Pack | float", /) -> "Pack": ...
    def __rsub__(self, other: float, /) -> "Pack": ...
    def __mul__(self, other: "Pack | float", /) -> "Pack": ...
    def __rmul__(self, other: float, /) -> "Pack": ...


# To a type checker an intrinsic is what it is in Python, where a call raises; to kernels it is a function.
load = cast(Callable[[Floats, int, int], Pack], _load)
store = cast(Callable[[Floats, int, int, Pack], None], _store)
place = cast(Callable[[Floats, int, int], int], _place)
get = cast(Callable[[int], Pack], _get)
fetch = cast(Callable[[int], None], _fetch)
put = cast(Callable[[int, Pack], None], _put)
from_lane = cast(Callable[[Pack, Pack, int], Pack], _from_lane)
splat = cast(Callable[[float], Pack], _splat)
first = cast(Callable[[Pack], float], _first)
with_first = cast(Callable[[Pack, float], Pack], _with_first)
total = cast(Callable[[Pack], float], _total)
Scalar = TypeVar("Scalar", float, Pack)
positive = cast(Callable[[Scalar], Scalar], _positive)
transpose = cast(Callable[[Floats, int, int, Floats, int, int], None], _transpose)
flush_denormals = cast(Callable[[], int], _flush_denormals)
restore_denormals = cast(Callable[[int], None], _restore_denormals)


def _lanewise(instruction: str) -> Any:
    """The intrinsic that applies an LLVM instruction to two packs."""

    @intrinsic
    def apply(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return getattr(builder, instruction)(*arguments, flags=FAST)

        return pack(pack, pack), generate

    return apply


def _overload(symbol: Callable[[Any, Any], Any], instruction: str) -> None:
    """Teach numba an operator for packs, and for packs with floats."""
    apply = _lanewise(instruction)

    @overload(symbol)
    def choose(a, b):  # type: ignore[no-untyped-def]  # numba compares the names and annotations
        if isinstance(a, PackType) and isinstance(b, PackType):
            return lambda a, b: apply(a, b)
        if isinstance(a, PackType) and isinstance(b, types.Float):
            return lambda a, b: apply(a, splat(b))
        if isinstance(a, types.Float) and isinstance(b, PackType):
            return lambda a, b: apply(splat(a), b)
        return None


_overload(operator.add, "fadd")
_overload(operator.sub, "fsub")
_overload(operator.mul, "fmul")
