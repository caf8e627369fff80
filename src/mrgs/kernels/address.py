"""Addresses inside arrays: functions that take them count no references and compile faster than
with slices."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic


@intrinsic
def address(typingctx: Any, array: Any, index: Any) -> Any:
    """Where a contiguous array holds its element ``index``, counted through all dimensions.

    What comes back is read and written like an array, unchecked. It does not keep the array alive:
    take addresses of the function's arguments only, whose caller does.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.int64)])

    return types.CPointer(array.dtype)(array, index), codegen


@intrinsic
def moved(typingctx: Any, pointer: Any, count: Any) -> Any:
    """The address ``count`` elements further on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.gep(args[0], [context.cast(builder, args[1], sig.args[1], types.int64)])

    return pointer(pointer, count), codegen
