"""Load array entries into the cache before a compiled kernel needs them."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic


def _prefetch(typing_context: Any, array: Any, row: Any, column: Any):
    """Start to load ``array[row, column]``, or ``array[row]`` of a list, into the cache; for compiled code.

    A hint and nothing else: no result depends on it, and an index outside the array does no harm.

    Args:
        typing_context: Numba's; not passed by the caller.
        array: Array of one or two dimensions.
        row: First index.
        column: Second index; of a list it is ignored.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_type = signature.args[0]
        made = context.make_array(array_type)(context, builder, arguments[0])
        index = [
            context.cast(builder, value, kind, types.intp)
            for value, kind in zip(arguments[1:], signature.args[1:], strict=True)
        ][: array_type.ndim]
        place = cgutils.get_item_pointer(context, builder, array_type, made, index, wraparound=False, boundscheck=False)
        address = builder.bitcast(place, cgutils.voidptr_t)
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        hint = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        # To be read; to be kept in all caches; data.
        builder.call(hint, [address, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, row, column), generate


prefetch: Any = intrinsic(_prefetch)
"""Called as ``prefetch(array, row, column)``, see `_prefetch`; numba brings the first argument."""
