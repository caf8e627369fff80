"""What is compiled of a Triton kernel, given once: for its launch, for the table of its resources
and for the tests.

Each package of kernels lists its own in a ``KERNELS: tuple[KernelSpec, ...]``, one entry for every
specialisation that is launched. ``python -m benchmarks.gpu_resources`` compiles them all on a
machine without a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import triton

Arguments: TypeAlias = dict[str, Any]
"""Tensors and numbers by the names of a kernel's arguments."""


class KernelSpec(NamedTuple):
    """One specialisation of a ``@triton.jit`` kernel, with the constants that its launch uses.

    Attributes:
        signature: type of every argument that is not a constant, by name: "*fp32", "*i32", "*i64",
            "i32", "fp32", ... Tensors are compiled as the launcher finds them: their first element
            lies at a multiple of 16 bytes.
        constexprs: value of every ``tl.constexpr`` argument, by name; and None for a tensor that
            the launch leaves out.
        num_warps: warps of 32 threads per program.
        num_stages: iterations of a loop whose loads may be in flight at once; 3 is what Triton
            takes for a launch that does not say.
        variant: distinguishes this specialisation from the others of its kernel ("fused", "rgb");
            empty if there is only this one.
    """

    kernel: Any
    signature: dict[str, str]
    constexprs: dict[str, Any]
    num_warps: int = 4
    num_stages: int = 3
    variant: str = ""

    @property
    def name(self) -> str:
        """Name in tables and messages: the function's, and the variant in brackets."""
        function = self.kernel.__name__
        return f"{function}[{self.variant}]" if self.variant else function

    def launch(self, grid: tuple[int, ...], arguments: Arguments) -> None:
        """Start the programs of a grid; the kernel takes its arguments by name from those given."""
        given = {name: arguments[name] for name in self.signature}
        self.kernel[grid](
            **given, **self.constexprs, num_warps=self.num_warps, num_stages=self.num_stages
        )


def specialised(
    kernel: Any,
    constants: dict[str, Any],
    types: Mapping[str, str],
    num_warps: int = 4,
    num_stages: int = 3,
    variant: str = "",
) -> KernelSpec:
    """An entry from the kernel's constants and the types of its other arguments; those without one
    are tensors of float32."""
    names = (name for name in kernel.arg_names if name not in constants)
    signature = {name: types.get(name, "*fp32") for name in names}
    return KernelSpec(kernel, signature, constants, num_warps, num_stages, variant)


def device_function(function: Callable) -> Any:
    """``triton.jit`` for what only kernels call; left as it is where Triton interprets, which takes
    milliseconds to enter each function that it knows of."""
    jitted = triton.jit(function)
    return jitted if isinstance(jitted, triton.JITFunction) else function
