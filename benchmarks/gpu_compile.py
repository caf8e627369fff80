"""Compiles every Triton kernel of the package for a GPU that need not be there, and prints what
each takes as JSON.

``python -m benchmarks.gpu_compile CAPABILITY`` is started by ``gpu_resources``, in a process of its
own: Triton decides when it is imported whether it interprets.
"""

from __future__ import annotations

import importlib
import io
import json
import re
import sys
from collections.abc import Iterable
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import mrgs
from mrgs.kernels import gpu_spec
from mrgs.kernels.gpu_spec import KernelSpec

ALIGNMENT_BYTES = 16
"""Where Triton finds a tensor's first element at a multiple of this, it loads several elements at
once."""

SOURCE = Path(mrgs.__file__).parent


def kernel_modules() -> list[ModuleType]:
    """Every module of the package whose source mentions ``triton.jit`` or ``KERNELS``, imported."""
    paths = [
        path.relative_to(SOURCE.parent)
        for path in sorted(SOURCE.rglob("*.py"))
        if _mentions_kernels(path)
    ]
    names = [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in paths]
    return [importlib.import_module(name) for name in names if name != gpu_spec.__name__]


def _mentions_kernels(path: Path) -> bool:
    return re.search(r"triton\.jit|\bKERNELS\b", path.read_text(encoding="utf-8")) is not None


def listed(modules: Iterable[ModuleType]) -> dict[str, KernelSpec]:
    """The specialisations of all lists, by folder and name of the kernel ("rasterize:
    blend[rgb]").

    Raises:
        ValueError: two specialisations of a list have the same name.
    """
    specs: dict[str, KernelSpec] = {}
    for spec in (spec for module in modules for spec in getattr(module, "KERNELS", ())):
        key = f"{spec.kernel.fn.__module__.split('.')[2]}: {spec.name}"
        if specs.setdefault(key, spec) is not spec:
            raise ValueError(
                f"two entries of KERNELS are called {key}: tell them apart by their variant"
            )
    return specs


def unlisted(modules: Iterable[ModuleType], specs: Iterable[KernelSpec]) -> list[str]:
    """Names of the kernels that no list has; what other kernels call is no kernel of its own."""
    found = {
        id(value): value
        for module in modules
        for value in vars(module).values()
        if _is_jitted(value)
    }
    known = {id(spec.kernel) for spec in specs}
    called = {name for function in found.values() for name in function.fn.__code__.co_names}
    missing = [function.fn for key, function in found.items() if key not in known]
    return sorted(f"{fn.__module__}.{fn.__name__}" for fn in missing if fn.__name__ not in called)


def _is_jitted(value: object) -> bool:
    """Whether ``@triton.jit`` made this, in the package rather than in Triton's own library."""
    fn = getattr(value, "fn", None)
    return (
        hasattr(value, "arg_names") and getattr(fn, "__module__", "").split(".")[0] == SOURCE.name
    )


def resources(spec: KernelSpec, capability: int) -> dict[str, int]:
    """Registers per thread, bytes of spills and of stack per thread, and bytes of shared memory per
    program.

    Raises:
        ValueError: the entry names other arguments than the kernel has.
    """
    from triton import compile as compile_kernel
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    names = spec.kernel.arg_names
    types = {
        name: "constexpr" if name in spec.constexprs else spec.signature.get(name) for name in names
    }
    given = {*spec.signature, *spec.constexprs}
    if set(names) != given or len(given) != len(spec.signature) + len(spec.constexprs):
        raise ValueError(
            f"{spec.name} takes {', '.join(names)}; its entry of KERNELS gives "
            f"{', '.join(sorted(given))}"
        )
    attributes = {
        (i,): [["tt.divisibility", ALIGNMENT_BYTES]]
        for i, name in enumerate(names)
        if str(types[name]).startswith("*")
    }
    constants = {(names.index(name),): value for name, value in spec.constexprs.items()}
    source = ASTSource(spec.kernel, types, constants, attributes)
    log = io.StringIO()
    with redirect_stdout(log):
        compiled = compile_kernel(
            source,
            target=GPUTarget("cuda", capability, 32),
            options={"num_warps": spec.num_warps, "num_stages": spec.num_stages},
        )
    return {
        **parse_log(log.getvalue()),
        "shared": compiled.metadata.shared,
        "warps": spec.num_warps,
    }


def parse_log(log: str) -> dict[str, int]:
    """What ``ptxas -v`` says; of a kernel and the functions it does not inline, the most registers
    and all spills.

    Raises:
        ValueError: the text has no such lines.
    """
    registers = [int(n) for n in re.findall(r"Used (\d+) registers", log)]
    pattern = r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
    frames = [tuple(map(int, frame)) for frame in re.findall(pattern, log)]
    if not registers or not frames:
        raise ValueError(f"ptxas told nothing of its registers and spills: {log.strip()!r}")
    stack, stores, loads = (sum(column) for column in zip(*frames, strict=True))
    return {
        "registers": max(registers),
        "spill_stores": stores,
        "spill_loads": loads,
        "stack": stack,
    }


def compile_all(capability: int) -> dict[str, Any]:
    """Triton's version, the resources of every specialisation by its name, and the unlisted
    kernels.

    Raises:
        RuntimeError: a specialisation cannot be compiled; the message names it.
    """
    modules = kernel_modules()
    import triton

    specs = listed(modules)
    kernels = {name: _compiled(name, spec, capability) for name, spec in specs.items()}
    return {
        "triton": triton.__version__,
        "kernels": kernels,
        "unlisted": unlisted(modules, specs.values()),
    }


def _compiled(name: str, spec: KernelSpec, capability: int) -> dict[str, int]:
    try:
        return resources(spec, capability)
    except Exception as error:
        raise RuntimeError(f"{name} cannot be compiled for sm_{capability}") from error


if __name__ == "__main__":
    sys.stdout.write(json.dumps(compile_all(int(sys.argv[1]))))
